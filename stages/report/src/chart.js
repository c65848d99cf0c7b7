"use strict";
// Charts as SVG: lines and points with round numbers on the axes. A pointer or the arrow keys read points; a click or
// Enter picks one.

const SVG = "http://www.w3.org/2000/svg";
const MARKS = [
  "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0-8 0z",
  "M-3.5-3.5h7v7h-7z",
  "M0-4.6L4.4 3.4h-8.8z",
  "M0-5L5 0L0 5L-5 0z",
  "M-4.2-4.2L4.2 4.2M4.2-4.2L-4.2 4.2",
  "M0-4.6v9.2M-4.6 0h9.2",
];
/** Maximum number of series with distinct colours and marks; with more series, only chosen ones have their own. */
const MAX_COLOURS = MARKS.length;
const MARGIN = { left: 60, right: 14, top: 12, bottom: 42 };
const HEIGHT = 270;
/** Maximum width of a name on an axis, in pixels. */
const MAX_NAME_WIDTH = 110;
/** Minimum distance between two names on an axis, in pixels. */
const NAME_GAP = 10;
/** Maximum distance in pixels at which a pointer reads a point. */
const REACH = 44;

function element(name, attributes, parent, text) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  parent?.append(made);
  return made;
}

/** Appends text that may be broken after punctuation, so that no word is cut. */
function breakable(parent, text) {
  for (const part of text.split(/(?<=[_\-=,/.])/)) parent.append(part, document.createElement("wbr"));
}

function shape(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  parent.append(made);
  return made;
}

/** Returns about `count` round numbers from `low` to `high`; whole ones if `isWhole`. */
function roundNumbers(low, high, count, isWhole) {
  const span = high - low;
  const power = 10 ** Math.floor(Math.log10(span / count));
  const found = power * [1, 2, 5, 10].find((factor) => span / (factor * power) <= count);
  const step = isWhole ? Math.max(1, found) : found;
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, i) => (first + i) * step);
}

/** Returns 1, 2 and 5 times powers of 10, or only the powers, from `low` to `high`; whole ones if `isWhole`. */
function roundLogNumbers(low, high, isWhole) {
  const numbers = [];
  for (let power = 10 ** Math.floor(Math.log10(low)); power <= high; power *= 10) {
    numbers.push(...[1, 2, 5].map((factor) => factor * power));
  }
  const within = numbers.filter(
    (number) => number >= low * 0.999 && number <= high * 1.001 && (!isWhole || Number.isInteger(number)),
  );
  const isPower = (number) => Math.abs(Math.log10(number) % 1) < 1e-9;
  return within.length > 7 ? within.filter(isPower) : within;
}

function shortNumber(value) {
  const size = Math.abs(value);
  if (size >= 1e6) return `${Number((value / 1e6).toPrecision(3))} M`;
  if (size >= 1e4) return `${Number((value / 1e3).toPrecision(3))} k`;
  return String(Number(value.toPrecision(4)));
}

/** Sets a label's text, shortened in the middle to at most `limit` pixels. Returns its width. */
function fitText(label, text, limit) {
  label.textContent = text;
  for (let kept = text.length - 1; kept > 2 && label.getComputedTextLength() > limit; kept -= 1)
    label.textContent = `${text.slice(0, Math.ceil(kept / 2))}…${text.slice(text.length - Math.floor(kept / 2))}`;
  return label.getComputedTextLength();
}

/** Axis: maps values to 0..1, and has round numbers. */
function axis(values, { log = false, names = null, count }) {
  if (names) {
    const place = (value) => (names.length < 2 ? 0.5 : 0.04 + (0.92 * value) / (names.length - 1));
    return { place, ticks: names.map((name, value) => ({ value, text: name })) };
  }
  const isWhole = values.every(Number.isInteger);
  let [low, high] = [Math.min(...values), Math.max(...values)];
  if (log) {
    [low, high] = [low / 1.15, high * 1.15];
    const place = (value) => Math.log(value / low) / Math.log(high / low);
    const numbers = roundLogNumbers(low, high, isWhole);
    return { place, ticks: numbers.map((value) => ({ value, text: shortNumber(value) })) };
  }
  const room = (high - low) * 0.06 || Math.abs(high) * 0.05 || 1;
  [low, high] = [low - room, high + room];
  const ticks = roundNumbers(low, high, count, isWhole).map((value) => ({ value, text: shortNumber(value) }));
  return { place: (value) => (value - low) / (high - low), ticks };
}

/**
 * Chart in the element `home`. `spec` has: `title`; `x` and `y`, each with `label`, and for x `log` or `names`; `series`,
 * each with `label`, `points` of `x`, `y`, `text` and `key`, and `chosen`: 1 for the left and 2 for the right result,
 * otherwise undefined; `lines`; `named` if points are labelled with their series' names where there is room; `front`,
 * points that a dashed line joins; `pick(point)`.
 */
class Chart {
  constructor(home) {
    this.home = element("figure", { class: "chart" }, home);
    this.heading = element("figcaption", {}, this.home);
    this.legend = element("div", { class: "legend" }, this.home);
    this.plot = element("div", { class: "plot", tabindex: "0", role: "group" }, this.home);
    this.tip = element("div", { class: "tip", role: "status" }, this.plot);
    this.plot.addEventListener("pointermove", (event) => this.read(this.nearest(event)));
    this.plot.addEventListener("pointerleave", () => this.read(null));
    this.plot.addEventListener("blur", () => this.read(null));
    this.plot.addEventListener("click", (event) => this.pick(this.nearest(event)));
    this.plot.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.width !== this.plot.clientWidth && this.draw()).observe(this.plot);
  }

  show(spec) {
    this.spec = spec;
    this.draw();
  }

  draw() {
    const { spec, plot } = this;
    this.width = plot.clientWidth;
    if (!spec || !this.width) return;
    this.svg?.remove();
    this.heading.textContent = spec.title;
    plot.setAttribute(
      "aria-label",
      `Chart: ${spec.title}. Arrow keys read its points${spec.pick ? ", Enter shows one" : ""}.`,
    );
    const points = spec.series.flatMap((series) => series.points);
    const inner = [this.width - MARGIN.left - MARGIN.right, HEIGHT - MARGIN.top - MARGIN.bottom];
    const x = axis(
      points.map((point) => point.x),
      { ...spec.x, count: Math.max(2, Math.round(inner[0] / 90)) },
    );
    const y = axis(
      points.map((point) => point.y),
      { ...spec.y, count: 5 },
    );
    this.svg = shape("svg", { width: this.width, height: HEIGHT, "aria-hidden": "true" }, plot);
    this.at = (point) => [MARGIN.left + x.place(point.x) * inner[0], MARGIN.top + (1 - y.place(point.y)) * inner[1]];
    this.frame(x, y, inner);
    if (spec.front?.length > 1) shape("path", { class: "front", d: this.path(spec.front) }, this.svg);
    const isCrowded = spec.series.length > MAX_COLOURS;
    const order = spec.series
      .map((series, i) => ({ series, i }))
      .sort((a, b) => (a.series.chosen ? 1 : 0) - (b.series.chosen ? 1 : 0));
    this.points = [];
    for (const { series, i } of order)
      this.drawSeries(
        series,
        isCrowded && !series.chosen ? "rest" : `c${(isCrowded ? series.chosen - 1 : i) % MAX_COLOURS}`,
        i,
      );
    this.ring = shape("circle", { class: "ring", r: 8, visibility: "hidden" }, this.svg);
    this.drawLegend(isCrowded);
  }

  frame(x, y, [width, height]) {
    const [left, bottom] = [MARGIN.left, MARGIN.top + height];
    for (const { value, text } of y.ticks) {
      const at = bottom - y.place(value) * height;
      shape("path", { class: "grid", d: `M${left} ${at}h${width}` }, this.svg);
      shape("text", { x: left - 8, y: at + 4, "text-anchor": "end" }, this.svg, text);
    }
    this.drawNumbers(x, [left, bottom], width);
    shape("path", { class: "axis", d: `M${left} ${bottom}h${width}` }, this.svg);
    shape(
      "text",
      { class: "label", x: left + width / 2, y: HEIGHT - 6, "text-anchor": "middle" },
      this.svg,
      this.spec.x.label,
    );
    const turned = `translate(13 ${MARGIN.top + height / 2}) rotate(-90)`;
    shape("text", { class: "label", transform: turned, "text-anchor": "middle" }, this.svg, this.spec.y.label);
  }

  /** Labels the horizontal axis: long names are shortened in the middle, and names without room are left out. */
  drawNumbers(x, [left, bottom], width) {
    let free = 0;
    for (const { value, text } of x.ticks) {
      const at = left + x.place(value) * width;
      const label = shape("text", { y: bottom + 18, "text-anchor": "middle" }, this.svg);
      const half = fitText(label, text, MAX_NAME_WIDTH) / 2;
      const middle = Math.min(Math.max(at, half), this.width - half);
      if (middle - half < free) {
        label.remove();
        continue;
      }
      label.setAttribute("x", middle);
      free = middle + half + NAME_GAP;
      shape("path", { class: "grid", d: `M${at} ${bottom}v4` }, this.svg);
    }
  }

  /** Returns the path of a line through points. */
  path(points) {
    return `M${points.map((point) => this.at(point).map((v) => v.toFixed(1)).join(" ")).join("L")}`;
  }

  drawSeries(series, colour, index) {
    const group = shape("g", { class: `series ${colour}` }, this.svg);
    const places = series.points.map((point) => this.at(point));
    if (this.spec.lines && places.length > 1) shape("path", { class: "line", d: this.path(series.points) }, group);
    const mark = MARKS[colour === "rest" ? 0 : Number(colour.slice(1))];
    series.points.forEach((point, i) => {
      const [x, y] = places[i];
      if (places.length < 60)
        shape("path", { class: "mark", d: mark, transform: `translate(${x.toFixed(1)} ${y.toFixed(1)})` }, group);
      this.points.push({ ...point, place: places[i], series, index, order: i });
    });
  }

  /** Labels points with their series' names where there is room, chosen series first. True if all have room. */
  drawNames() {
    const box = ([x, y], [width, height]) => ({ left: x, right: x + width, top: y, bottom: y + height });
    const overlap = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
    const inside = box([MARGIN.left, 0], [this.width - MARGIN.left, HEIGHT - MARGIN.bottom]);
    const isInside = ({ left, right, top, bottom }) =>
      left >= inside.left && right <= inside.right && top >= inside.top && bottom <= inside.bottom;
    const taken = this.points.map(({ place: [x, y] }) => box([x - 6, y - 6], [12, 12]));
    // Points are in drawing order: chosen ones last.
    const placed = this.points.toReversed().filter(({ place: [x, y], series }) => {
      const text = shape("text", { class: "name" }, this.svg, series.label);
      const size = [text.getComputedTextLength(), 13];
      const corners = [
        [x + 9, y - 7],
        [x - 9 - size[0], y - 7],
        [x - size[0] / 2, y - 22],
        [x - size[0] / 2, y + 9],
      ];
      const free = corners
        .map((corner) => box(corner, size))
        .find((place) => isInside(place) && !taken.some((other) => overlap(place, other)));
      if (!free) {
        text.remove();
        return false;
      }
      taken.push(free);
      text.setAttribute("x", free.left);
      text.setAttribute("y", free.bottom - 2);
      return true;
    });
    return placed.length === this.points.length;
  }

  drawLegend(isCrowded) {
    this.legend.replaceChildren();
    if (this.spec.named && this.drawNames()) return;
    if (this.spec.series.length < 2) return;
    for (const [i, series] of this.spec.series.entries()) {
      if (isCrowded && !series.chosen) continue;
      const colour = (isCrowded ? series.chosen - 1 : i) % MAX_COLOURS;
      const entry = element("span", {}, this.legend);
      const svg = shape("svg", { width: 14, height: 14, viewBox: "-7 -7 14 14", "aria-hidden": "true" }, entry);
      shape("path", { class: "mark", d: MARKS[colour] }, shape("g", { class: `series c${colour}` }, svg));
      entry.append(series.label);
    }
    const rest = this.spec.series.filter((series) => !series.chosen).length;
    const words = rest === this.spec.series.length ? `${rest} results in grey` : `and ${rest} others in grey`;
    if (isCrowded) element("span", { class: "rest" }, this.legend, words);
  }

  nearest(event) {
    const box = this.plot.getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    const far = ({ place }) => Math.hypot(place[0] - at[0], place[1] - at[1]);
    const near = (this.points ?? []).reduce((best, point) => (best && far(best) <= far(point) ? best : point), null);
    return near && far(near) <= REACH ? near : null;
  }

  /** Shows a point's text; null hides it. */
  read(point) {
    this.current = point;
    this.tip.textContent = point ? point.text : "";
    this.tip.classList.toggle("shown", Boolean(point));
    this.ring?.setAttribute("visibility", point ? "visible" : "hidden");
    this.plot.classList.toggle("picks", Boolean(point && this.spec.pick && point.key !== undefined));
    if (!point) return;
    const [x, y] = point.place;
    this.ring.setAttribute("cx", x);
    this.ring.setAttribute("cy", y);
    const half = this.tip.offsetWidth / 2;
    this.tip.style.left = `${Math.min(Math.max(x, half), this.width - half)}px`;
    this.tip.style.top = `${y > 70 ? y - 14 : y + 18 + this.tip.offsetHeight}px`;
  }

  pick(point) {
    if (point && this.spec.pick && point.key !== undefined) this.spec.pick(point);
  }

  key(event) {
    const steps = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowDown: [0, 1], ArrowUp: [0, -1] };
    if (event.key === "Enter" || event.key === " ") this.pick(this.current);
    else if (event.key === "Escape") this.read(null);
    else if (!steps[event.key]) return;
    else this.step(...steps[event.key]);
    event.preventDefault();
  }

  step(along, across) {
    const sorted = this.points.slice().sort((a, b) => a.index - b.index || a.order - b.order);
    if (!this.current) return this.read(sorted[0] ?? null);
    const { index, order } = this.current;
    const isSingle = this.spec.series.every((series) => series.points.length < 2);
    const to = isSingle ? { index: index + along + across, order: 0 } : { index: index + across, order: order + along };
    const found = sorted.filter((point) => point.index === to.index);
    const point = found[Math.min(Math.max(to.order, 0), found.length - 1)];
    if (point) this.read(point);
  }
}
