// Operates a report page like a user, in up to four sizes and colour schemes: page.mjs PAGE COUNT
//
// Prints for each of them the `problems` and the page's content (`summary`, and `numbers` by view,
// result and metric).
import { accessibilityFindings, open, report } from "./browser.mjs";

const PAGE = process.argv[2];
const PHONE = { width: 390, height: 844 };
const DESKTOP = { width: 1440, height: 900 };
const SIZES = [
  { ...PHONE, dark: true },
  { ...DESKTOP, dark: false },
  { ...PHONE, dark: false },
  { ...DESKTOP, dark: true },
].slice(0, Number(process.argv[3]));

async function look(browser, size) {
  const { page, problems } = await open(browser, PAGE, size);
  const expect = (isRight, words) => isRight || problems.push(words);
  const found = { size, problems, summary: await page.locator(".summary dd").allTextContents() };
  found.title = await page.locator("h1").textContent();
  if (await page.locator("#comparison").isVisible()) {
    const top = (await page.locator("#panes .pane").boundingBox()).y;
    const hasNotices = (await page.locator(".notice").count()) > 0;
    expect(hasNotices || top < 0.55 * size.height, `the first picture begins at ${top} of ${size.height} pixels`);
    await thumbnails(page, expect);
    found.numbers = await compare(page, expect);
    await zoom(page, expect);
    await link(browser, page, size, expect);
    await arrange(page, expect);
    await pick(page, expect);
    await front(page, expect);
  }
  await followGraph(page, expect);
  const isWide = await page.evaluate(() => document.documentElement.scrollWidth > innerWidth);
  expect(!isWide, "the page scrolls sideways");
  await page.locator("details").evaluateAll((all) => all.forEach((details) => (details.open = true)));
  await tables(page, expect);
  await plots(page, expect);
  problems.push(...(await accessibilityFindings(page)));
  expect(
    !(await page.evaluate(() => document.documentElement.scrollWidth > innerWidth)),
    "the open page scrolls sideways",
  );
  await page.context().close();
  return found;
}

/** Returns the numbers below the images, by row and column of their table. */
const readNumbers = (page) =>
  page.locator("#numbers").evaluate((table) => {
    const figures = [...table.querySelectorAll("thead th")].slice(1).map((cell) => cell.textContent);
    const row = (line) => [
      line.cells[0].textContent,
      Object.fromEntries(figures.map((name, i) => [name, line.cells[i + 1].textContent])),
    ];
    return Object.fromEntries([...table.querySelectorAll("tbody tr")].map(row));
  });

const options = (page, id) => page.locator(`#${id} option`).evaluateAll((all) => all.map((option) => option.value));
/** Returns the first six and last six values, because a page can have a hundred methods. */
const ends = (all) => [...all.slice(0, 6), ...all.slice(-6)].filter((value, i, some) => some.indexOf(value) === i);
const sources = (page) => page.locator("#panes img").evaluateAll((all) => all.map((image) => image.src));
const division = (page) =>
  page
    .locator("#panes .half")
    .nth(1)
    .evaluate((half) => half.style.clipPath);

/** Moves the slider, and selects all views and methods. */
async function compare(page, expect) {
  const before = await division(page);
  await page.locator("#split").press("Home");
  const home = await division(page);
  const pane = page.locator("#panes .pane");
  await pane.hover({ position: { x: 60, y: 60 } });
  await page.mouse.down();
  await page.mouse.move((await pane.boundingBox()).x + 100, 300, { steps: 4 });
  await page.mouse.up();
  expect(new Set([before, home, await division(page)]).size === 3, `the division stays at ${before}`);
  const numbers = {};
  for (const view of await options(page, "view")) {
    await page.locator("#view").selectOption(view);
    const name = await page.locator("#view option:checked").textContent();
    numbers[name] = {};
    const seen = new Set();
    for (const layer of ends(await options(page, "right"))) {
      await page.locator("#right").selectOption(layer);
      seen.add((await sources(page))[0]);
      Object.assign(numbers[name], await readNumbers(page));
    }
    expect(seen.size > 2, `${name} has ${seen.size} pictures`);
    const isBroken = await page.locator("#panes img").evaluateAll(async (all) => {
      await Promise.all(all.map((image) => image.decode().catch(() => {})));
      return all.some((image) => !image.naturalWidth);
    });
    expect(!isBroken, `a picture of ${name} can't be decoded`);
  }
  return numbers;
}

/** Checks that each view has a thumbnail, which shows the view. */
async function thumbnails(page, expect) {
  const views = await options(page, "view");
  const all = page.locator("#thumbnails button");
  expect((await all.count()) === views.length, `${await all.count()} thumbnails of ${views.length} views`);
  if (views.length < 2) return;
  await all.last().click();
  expect((await page.locator("#view").inputValue()) === views.at(-1), "a thumbnail doesn't show its view");
  expect((await all.last().getAttribute("aria-pressed")) === "true", "the view's thumbnail isn't marked");
  await all.first().click();
}

/** Checks that the page's address shows the same view and zoom again. */
async function link(browser, page, size, expect) {
  await page.locator("#view").selectOption({ index: (await options(page, "view")).length - 1 });
  await page.locator("#panes").press("+");
  const state = (one) =>
    one.evaluate(() => [
      document.getElementById("view").value,
      document.getElementById("zoom").textContent,
      document.querySelector("#panes .tag.right").textContent,
    ]);
  const before = await state(page);
  const { page: other } = await open(browser, PAGE, size);
  // The address follows after a moment without changes.
  await page.waitForTimeout(600);
  await other.goto(await page.evaluate(() => location.href));
  await other.reload();
  const after = await state(other);
  expect(JSON.stringify(before) === JSON.stringify(after), `a link shows ${after}, not ${before}`);
  await other.context().close();
  await page.locator("#fit").click();
}

/** Checks that tables are lower than the window and keep their heads, that wide ones show that they scroll, and that no word is broken and no caption cut. */
async function tables(page, expect) {
  const problems = await page.locator(".wide").evaluateAll((all) =>
    all.flatMap((region) => {
      const found = [];
      const hint = region.previousElementSibling;
      const isHinted = hint?.matches(".scroll-hint:not([hidden])") ?? false;
      const caption = region.querySelector("caption");
      if (caption) {
        const range = document.createRange();
        range.selectNodeContents(caption);
        const isCut = range.getBoundingClientRect().right > region.getBoundingClientRect().right + 1;
        if (isCut) found.push(`${caption.textContent} is cut`);
      }
      const name = region.getAttribute("aria-label") ?? region.getAttribute("aria-labelledby");
      if (region.clientHeight > 0.7 * innerHeight) found.push(`${name}: a table of ${region.clientHeight} pixels`);
      const head = region.querySelector("thead th");
      region.scrollTop = region.scrollHeight;
      const isAtTop = (box) => Math.abs(box.getBoundingClientRect().top - region.getBoundingClientRect().top) < 2;
      if (region.scrollTop > 100 && head && !isAtTop(head)) found.push(`${name}: the head scrolls away`);
      region.scrollTop = 0;
      if (isHinted !== region.scrollWidth - region.clientWidth >= 2) found.push("a wide table without a hint");
      for (const cell of region.querySelectorAll("th, td")) {
        for (const node of textNodes(cell)) {
          for (const { 0: word, index } of node.textContent.matchAll(/[^\s_\-=,/.…]+/g)) {
            const range = document.createRange();
            range.setStart(node, index);
            range.setEnd(node, index + word.length);
            const lines = new Set([...range.getClientRects()].map((rectangle) => Math.round(rectangle.top)));
            if (lines.size > 1) found.push(`${word} is broken`);
          }
        }
      }
      return found;

      function textNodes(cell) {
        const nodes = [];
        const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
        while (walker.nextNode()) nodes.push(walker.currentNode);
        return nodes;
      }
    }),
  );
  for (const problem of problems) expect(false, problem);
}

/** Checks that texts of plots are neither clipped nor overlapping, and that whole numbers have whole ticks. */
async function plots(page, expect) {
  const problems = await page.locator(".plot").evaluateAll((all) =>
    all.flatMap((plot) => {
      const box = plot.getBoundingClientRect();
      const texts = [...plot.querySelectorAll("svg text")].map((text) => [text, text.getBoundingClientRect()]);
      const clipped = texts.filter(([, { left, right }]) => left < box.left - 1 || right > box.right + 1);
      const overlap = (a, b) =>
        Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1 &&
        Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 4;
      const pairs = texts.flatMap(([one, a], i) =>
        texts.slice(i + 1).filter(([, b]) => overlap(a, b)).map(([other]) => [one, other]),
      );
      return [
        ...clipped.map(([text]) => `${text.textContent} is clipped`),
        ...pairs.map((pair) => `${pair.map((text) => text.textContent).join(" and ")} overlap`),
      ];
    }),
  );
  for (const problem of problems) expect(false, problem);
  const ticks = await page.evaluate("axis([1, 2], {}).ticks.map(({ value }) => value)");
  expect(ticks.every(Number.isInteger), `ticks ${ticks} of whole numbers`);
}

/** Checks that zoom and pan are kept when the view changes. */
async function zoom(page, expect) {
  const transform = () =>
    page
      .locator("#panes img")
      .first()
      .evaluate((image) => image.style.transform);
  const fit = await transform();
  await page.locator("#panes").press("+");
  await page.locator("#panes").press("ArrowRight");
  const near = await transform();
  await page.locator("#next").click();
  expect(near !== fit && (await transform()) === near, `zoom: ${fit}, ${near}, ${await transform()}`);
  await page.locator("#fit").click();
  expect((await transform()) === fit, "fit doesn't fit");
}

async function arrange(page, expect) {
  await page.locator("#grid-mode").click();
  expect((await page.locator("#panes .pane").count()) > 1, "the grid has fewer than two panes");
  await marked(page, expect, "#grid-mode", "#slider-mode");
  await page.locator("#slider-mode").click();
  await marked(page, expect, "#slider-mode", "#grid-mode");
  expect((await page.locator("#panes .pane").count()) === 1, "the slider has more than one pane");
}

/** Checks that the button of the active mode stands out, and that neither button looks disabled. */
async function marked(page, expect, active, other) {
  const styles = await Promise.all(
    [active, other].map((id) =>
      page.locator(id).evaluate((button) => {
        const { backgroundColor, opacity } = getComputedStyle(button);
        return { backgroundColor, opacity, isDisabled: button.disabled };
      }),
    ),
  );
  const isPlain = styles.every(({ opacity, isDisabled }) => opacity === "1" && !isDisabled);
  expect(isPlain, `${active} or ${other} looks disabled`);
  expect(styles[0].backgroundColor !== styles[1].backgroundColor, `${active} isn't marked`);
}

/** Checks that selecting a point in a plot of all views selects its view. */
async function pick(page, expect) {
  const plot = page.locator(".plot").first();
  if (!(await page.locator(".chart figcaption", { hasText: "of every view" }).count())) return;
  await page.locator("#view").selectOption({ index: 0 });
  const before = await page.locator("#view").inputValue();
  await plot.focus();
  for (const key of ["ArrowRight", "ArrowRight"]) await plot.press(key);
  const text = await plot.locator(".tip").textContent();
  await plot.press("Enter");
  const name = await page.locator("#view option:checked").textContent();
  expect(
    text.startsWith(`${name}`) && (await page.locator("#view").inputValue()) !== before,
    `the plot picks ${name} for ${text}`,
  );
}

/** Checks that the front has the results that no other beats, and is drawn where the title says so. */
async function front(page, expect) {
  const points = [[3, 2], [1, 2], [2, 1], [3, 4]].map(([x, y]) => ({ x, y }));
  for (const [isLower, expected] of [[false, "12 34"], [true, "12 21"]]) {
    const found = await page.evaluate(([p, lower]) => frontOf(p, lower).map(({ x, y }) => `${x}${y}`), [points, isLower]);
    expect(found.join(" ") === expected, `the front is ${found}`);
  }
  const said = await page.locator(".chart figcaption", { hasText: "dashed" }).count();
  expect(said === (await page.locator("path.front").count()), "a front is missing, or isn't explained");
}

/** Checks that a box of the graph opens the details of its stage. */
async function followGraph(page, expect) {
  const boxes = page.locator(".graph a");
  if (!(await boxes.count())) return expect(false, "there is no graph");
  await boxes.last().focus();
  await page.keyboard.press("Enter");
  const isOpen = await page
    .locator("details.stage")
    .last()
    .evaluate((details) => details.open);
  expect(isOpen, "a box of the graph opens nothing");
}

await report({}, async (browser) => {
  const looks = [];
  for (const size of SIZES) looks.push(await look(browser, size));
  return looks;
});
