"use strict";
// Entry point: starts the page's parts.

function copyButtons() {
  for (const command of document.querySelectorAll(".command")) {
    const button = element("button", { type: "button", class: "copy" }, command, "Copy");
    button.addEventListener("click", async () => {
      try {
        await navigator.clipboard.writeText(command.querySelector("code").textContent);
        button.textContent = "Copied";
      } catch {
        getSelection().selectAllChildren(command.querySelector("code"));
        button.textContent = "Press Ctrl+C";
      }
    });
  }
}

/** Shows above each table that is wider than its window that it scrolls. */
function scrollHints() {
  for (const region of document.querySelectorAll(".wide")) {
    const hint = element("p", { class: "note scroll-hint" }, null, "Scroll sideways for more columns →");
    region.before(hint);
    const update = () => {
      const rest = region.scrollWidth - region.clientWidth;
      hint.hidden = rest < 2;
      region.classList.toggle("cut", rest - region.scrollLeft >= 2);
    };
    region.addEventListener("scroll", update, { passive: true });
    const observer = new ResizeObserver(update);
    for (const observed of [region, ...region.children]) observer.observe(observed);
    update();
  }
}

/** Opens the folded part that a link leads to. */
function openTargets() {
  for (const link of document.querySelectorAll(".graph a, a.term")) {
    link.addEventListener("click", () => {
      // A figure's name may have any character, so the target is found by id, not by selector.
      const target = document.getElementById(link.getAttribute("href").slice(1));
      const details = target?.closest("details");
      if (details) details.open = true;
    });
  }
}

function startPage() {
  copyButtons();
  scrollHints();
  openTargets();
  const text = document.getElementById("data").textContent;
  if (!text) return;
  const data = JSON.parse(text);
  let plots = null;
  const rowsOf = ({ left, right }) => [left, right].map((layer) => data.layers[layer]?.rows[0] ?? -1);
  const comparison = data.pictures.length ? new Comparison(data, (state) => plots?.choose(rowsOf(state))) : null;
  if (!data.rows.length) return;
  plots = new Plots(data, (view) => {
    comparison?.show({ view });
    document.getElementById("compare").scrollIntoView({ block: "start" });
  });
  if (comparison) plots.choose(rowsOf(comparison.state));
}

startPage();
