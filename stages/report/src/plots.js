"use strict";
// Choice of plots: figures of every view, trade-offs, sweeps and trainings.

/** Minimum ratio of the largest to the smallest value for a logarithmic axis; chosen by hand. */
const LOG_RANGE = 10;
/** Maximum number of labelled points in a plot; chosen by hand. */
const MAX_NAMES = 12;

const isLog = (values) => Math.min(...values) > 0 && Math.max(...values) / Math.min(...values) >= LOG_RANGE;

function duration(seconds) {
  return seconds < 90 ? `${seconds.toFixed(1)} s` : `${(seconds / 60).toFixed(1)} min`;
}

/** Returns the points that are better than all points with a smaller or equal x, from the least x. */
function frontOf(points, lowerIsBetter) {
  const value = ({ y }) => (lowerIsBetter ? -y : y);
  const sorted = points.toSorted((a, b) => a.x - b.x || value(b) - value(a));
  let best = -Infinity;
  return sorted.filter((point) => {
    const isBetter = value(point) > best;
    best = Math.max(best, value(point));
    return isBetter;
  });
}

class Plots {
  /** `show(view)` shows a view in the comparison. */
  constructor(data, show) {
    this.data = data;
    this.show = show;
    this.pictured = new Set(data.pictures.map((picture) => picture.view));
    this.chosen = [];
    const find = (id) => document.getElementById(id);
    this.figure = find("figure");
    this.axis = find("axis");
    find("plots").hidden = false;
    data.figures.forEach(({ label }, i) => element("option", { value: i }, this.figure, label));
    this.axes = this.sweptAxes();
    this.axes.forEach((name) => element("option", { value: name }, this.axis, name));
    this.axis.closest(".field").hidden = this.axes.length < 2;
    const charts = find("charts");
    this.charts = {};
    if (data.figures.length) {
      if (data.rows.some((row) => row.scores.filter(Boolean).length > 1)) this.charts.views = new Chart(charts);
      if (data.rows.length > 1 && data.rows.some((row) => row.training > 0)) this.charts.tradeOff = new Chart(charts);
      if (this.axes.length) this.charts.sweep = new Chart(charts);
    }
    this.figure.closest(".field").hidden = !Object.keys(this.charts).length;
    if (data.curves.length) this.charts.training = new Chart(charts);
    for (const select of [this.figure, this.axis]) select.addEventListener("change", () => this.draw());
    if (!Object.keys(this.charts).length) find("plots").hidden = true;
    this.draw();
  }

  /** Highlights the results that the comparison shows. */
  choose(indices) {
    this.chosen = indices;
    this.draw();
  }

  sweptAxes() {
    const names = [...new Set(this.data.rows.flatMap((row) => Object.keys(row.axes)))];
    const values = (name) => new Set(this.data.rows.map((row) => row.axes[name]));
    return names.filter((name) => values(name).size > 1);
  }

  draw() {
    const figure = Number(this.figure.value);
    this.charts.views?.show(this.viewsSpec(figure));
    this.charts.tradeOff?.show(this.tradeOffSpec(figure));
    this.charts.sweep?.show(this.sweepSpec(figure, this.axis.value || this.axes[0]));
    this.charts.training?.show(this.trainingSpec());
  }

  /** Returns 1 for the left and 2 for the right result, otherwise undefined. */
  mark(index) {
    const place = this.chosen.indexOf(index);
    return place < 0 ? undefined : place + 1;
  }

  /** Formats a figure. Its label may end in a unit, which follows the number, and in an arrow, which is left out. */
  text(value, figure) {
    const { label, digits } = this.data.figures[figure];
    const words = label.replace(/ ?[↑↓]/, "");
    const unit = words.endsWith(" dB") ? " dB" : "";
    return `${words.slice(0, words.length - unit.length)} ${value.toFixed(digits)}${unit}`;
  }

  viewsSpec(figure) {
    const { rows, views } = this.data;
    const scored = views.map((_, view) => view).filter((view) => rows.some((row) => row.scores[view]));
    const series = rows.map((row, index) => {
      const points = scored.flatMap((view, x) => {
        const y = row.scores[view]?.[figure];
        if (y == null) return [];
        const key = this.pictured.has(view) ? view : undefined;
        const which = rows.length > 1 ? `, ${row.label}` : "";
        return [{ x, y, key, text: `${views[view].name}${which}: ${this.text(y, figure)}` }];
      });
      return { label: row.label, points, chosen: this.mark(index) };
    });
    return {
      title: `${this.data.figures[figure].label} of every view`,
      lines: true,
      x: { label: "View", names: scored.map((view) => views[view].name) },
      y: { label: this.data.figures[figure].label },
      series: series.filter(({ points }) => points.length),
      pick: (point) => this.show(point.key),
    };
  }

  tradeOffSpec(figure) {
    const { rows, figures } = this.data;
    const times = rows.map((row) => row.training).filter((time) => time > 0);
    const series = rows.flatMap((row, index) => {
      const y = row.mean[figure];
      if (y == null || !(row.training > 0)) return [];
      const text = `${row.label}: ${this.text(y, figure)} in ${duration(row.training)}`;
      return [{ label: row.label, points: [{ x: row.training, y, text }], chosen: this.mark(index) }];
    });
    const front = frontOf(
      series.flatMap(({ points }) => points),
      figures[figure].label.includes("↓"),
    );
    return {
      title: `${figures[figure].label} against training time${front.length > 1 ? "; dashed: no result is faster and better" : ""}`,
      front,
      named: series.length <= MAX_NAMES,
      x: { label: "Training time, s", log: isLog(times) },
      y: { label: figures[figure].label },
      series,
    };
  }

  sweepSpec(figure, name) {
    const { rows, figures } = this.data;
    const values = [...new Set(rows.map((row) => row.axes[name]).filter((value) => value !== undefined))];
    const numbers = values.map(Number);
    const isNumeric = numbers.every(Number.isFinite);
    const groups = new Map();
    for (const row of rows) {
      const y = row.mean[figure];
      if (row.axes[name] === undefined || y == null) continue;
      const others = row.label
        .split(", ")
        .filter((part) => !part.startsWith(`${name}=`))
        .join(", ");
      const x = isNumeric ? Number(row.axes[name]) : values.indexOf(row.axes[name]);
      if (!groups.has(others)) groups.set(others, []);
      groups.get(others).push({ x, y, text: `${row.label}: ${this.text(y, figure)}` });
    }
    const series = [...groups].map(([label, points]) => ({
      label: label || "all",
      points: points.sort((a, b) => a.x - b.x),
    }));
    return {
      title: `${figures[figure].label} against ${name}`,
      lines: true,
      x: isNumeric ? { label: name, log: isLog(numbers) } : { label: name, names: values },
      y: { label: figures[figure].label },
      series,
    };
  }

  trainingSpec() {
    const series = this.data.curves.map(({ label, points }) => ({
      label,
      points: points.map(([x, y]) => ({ x, y, text: `${label}: ${y.toFixed(2)} dB after ${shortNumber(x)} rays` })),
    }));
    return {
      title: "Training curves: PSNR of training pixels",
      lines: true,
      x: { label: "Rays" },
      y: { label: "PSNR, dB" },
      series,
    };
  }
}
