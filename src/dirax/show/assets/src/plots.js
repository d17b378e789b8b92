// Plots that move with the scene: quantities against time, and phase planes.

import uPlot from "uplot";
import { before, exact, nearest } from "./data.js";
import { kept } from "./thin.js";

const HEIGHT = 210;
const SHOWN = 6; // lines of one plot at first
const FONT = '12px system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", sans-serif';

const MODES = { value: "value", change: "change", log: "log" };

export function element(kind, properties = {}, ...children) {
  const { dataset, ...others } = properties;
  const made = Object.assign(document.createElement(kind), others);
  Object.assign(made.dataset, dataset);
  made.append(...children);
  return made;
}

// What all plots have: a figure with a title, choices, a place for uPlot, a caption of exact numbers.
class Plot {
  constructor(chart, data, clock, colours) {
    Object.assign(this, { chart, data, clock, colours });
    this.time = clock.time;
    this.mode = chart.modes?.[0];
    this.choices = this.choose();
    this.choice = 0;
    this.head = element("div", { className: "plot-head" }, element("h3", { textContent: chart.title }));
    this.host = element("div", { className: "plot", tabIndex: 0 });
    this.host.setAttribute("role", "img");
    this.caption = element("figcaption");
    this.figure = element("figure", {}, this.head, this.host, this.caption);
    this.controls();
    new ResizeObserver(() => this.resize()).observe(this.host);
  }

  controls() {
    const { chart } = this;
    if (this.choices.length > 1) this.head.append(this.select("quantity", this.choices.map((c) => c.label), (k) => this.pick({ choice: k })));
    if (chart.modes?.length > 1) {
      this.modes = this.select("scale", chart.modes.map((m) => MODES[m]), (k) => this.pick({ mode: chart.modes[k] }));
      this.head.append(this.modes);
    }
    this.whole = element("button", { type: "button", textContent: "whole", hidden: true, title: "show all of it again" });
    this.whole.setAttribute("aria-label", `${chart.title}: show the whole range`);
    this.whole.onclick = () => this.zoom(null);
    this.head.append(this.whole);
  }

  select(what, labels, chosen) {
    const options = labels.map((text, value) => element("option", { value, textContent: text }));
    const made = element("select", {}, ...options);
    made.setAttribute("aria-label", `${this.chart.title}: ${what}`);
    made.onchange = () => chosen(Number(made.value));
    return made;
  }

  pick(change) {
    Object.assign(this, change);
    this.range = null;
    this.build();
  }

  resize() {
    const width = this.host.clientWidth;
    if (!this.plot || !width || width === this.width) return;
    this.build();
  }

  repaint(colours) {
    this.colours = colours;
    this.build();
  }

  axes() {
    const { soft, grid } = this.colours;
    const common = { stroke: soft, font: FONT, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1, size: 4 } };
    const size = (plot, values) => (values ? 14 + Math.max(...values.map((v) => String(v ?? "").length), 2) * 7 : 40);
    return [
      { ...common, size: 30, space: 60, values: (_, splits, axis, space, step) => labels(splits, step) },
      { ...common, size, space: 34, values: (_, splits, axis, space, step) => labels(splits, step) },
    ];
  }

  swatch(colour) {
    const made = element("span", { className: "swatch" });
    made.style.background = colour;
    return made;
  }

  colourOf(k, line) {
    const { series, ink } = this.colours;
    const run = this.data.runs[k];
    if (run.closed) return ink;
    return series[(this.data.several ? run.colour : line) % series.length];
  }

  // Pointer and click, without those that end a drag.
  listen(over, hover, click) {
    let start = null;
    over.addEventListener("mousedown", (event) => (start = [event.clientX, event.clientY]));
    over.addEventListener("mousemove", (event) => hover(event.offsetX, event.offsetY));
    over.addEventListener("mouseleave", () => hover(null));
    over.addEventListener("click", (event) => {
      if (start && Math.hypot(event.clientX - start[0], event.clientY - start[1]) < 4) click(event.offsetX, event.offsetY);
    });
    over.addEventListener("dblclick", () => this.zoom(null));
  }
}

export class TimePlot extends Plot {
  // Lines are components of one run, or one component of several runs.
  choose() {
    const { chart, data } = this;
    const tables = data.runs.map((run) => run.tables[chart.table]);
    const longest = tables.reduce((a, b) => (b && (!a || b.columns.length > a.columns.length) ? b : a), undefined);
    const names = chart.columns.map((c) => longest.columns[c]);
    if (data.several) {
      const runs = data.runs.flatMap((run, k) => (tables[k] ? [k] : []));
      return chart.columns.map((column, i) => ({
        label: names[i],
        lines: runs.filter((k) => column < tables[k].columns.length).map((k) => ({ run: k, column, label: data.runs[k].label })),
      }));
    }
    const all = chart.columns.map((column, i) => ({ run: 0, column, label: names[i] }));
    if (all.length <= SHOWN) return [{ label: "all", lines: all }];
    return [{ label: `first ${SHOWN}`, lines: all.slice(0, SHOWN) }, ...all.map((line) => ({ label: line.label, lines: [line] }))];
  }

  // The points of a line: t, exact values, and what is drawn of them.
  line({ run, column, label }, k) {
    const table = this.data.runs[run].tables[this.chart.table];
    table.t ??= table.rows ? Float64Array.from(table.rows, (row) => this.data.runs[run].t[row]) : this.data.runs[run].t;
    const values = table.values[column];
    const base = values[0];
    const shift = this.mode === "change" || (this.mode === "log" && this.chart.modes.includes("change"));
    let drawn = shift ? Float64Array.from(values, (x) => x - base) : values;
    if (this.mode === "log") drawn = Float64Array.from(drawn, (x) => (x === 0 ? NaN : Math.abs(x)));
    return { run, label, t: table.t, values, drawn, shift, digits: table.digits, colour: this.colourOf(run, k), ghost: this.data.runs[run].ghost };
  }

  build() {
    const { host, chart } = this;
    this.width = host.clientWidth;
    if (!this.width) return;
    const kept = this.range;
    this.lines = this.choices[this.choice].lines.map((line, k) => this.line(line, k));
    this.plot?.destroy();
    const log = this.mode === "log" && this.lines.some((line) => line.drawn.some((x) => x > 0));
    const { span } = this.data;
    const [first, last] = kept ?? span;
    const options = {
      width: this.width,
      height: HEIGHT,
      legend: { show: false },
      cursor: { y: false, drag: { x: true, y: false, setScale: false }, points: { show: false }, bind: { dblclick: () => null } },
      scales: { x: { time: false, min: first, max: last, auto: false }, y: log ? { distr: 3 } : { range: (_, low, high) => padded(low, high) } },
      axes: this.axes(),
      series: [{}, ...this.lines.map((line) => ({ stroke: faint(line.colour, line.ghost), width: 1.4, points: { show: false }, spanGaps: true }))],
      hooks: { setSelect: [(plot) => this.selected(plot)] },
    };
    this.plot = new uPlot(options, this.points(first, last), host);
    this.now = element("div", { className: "now" });
    this.plot.over.append(this.now);
    this.listen(
      this.plot.over,
      (x) => this.tell(x === null ? null : this.plot.posToVal(x, "x")),
      (x) => this.clock.seek(this.plot.posToVal(x, "x")),
    );
    this.whole.hidden = !kept;
    host.setAttribute("aria-label", this.spoken());
    this.tell(null);
    this.show(this.time);
  }

  // Columns for uPlot, decimated to the width; lines of different times are joined.
  points(first, last) {
    const tables = this.lines.map(({ t, drawn }) => {
      const low = Math.max(0, before(t, first) - 1);
      const high = Math.min(drawn.length - 1, before(t, last) + 2);
      const rows = high >= low ? kept([drawn], low, high, Math.max(50, this.width)) : [];
      return [rows.map((i) => t[i]), rows.map((i) => (Number.isFinite(drawn[i]) ? drawn[i] : null))];
    });
    return tables.length === 1 ? tables[0] : uPlot.join(tables);
  }

  selected(plot) {
    const { left, width } = plot.select;
    if (width < 4) return;
    const range = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.zoom(range);
  }

  zoom(range) {
    this.range = range;
    this.build();
  }

  show(time) {
    this.time = time;
    if (!this.plot) return;
    const x = this.plot.valToPos(time, "x");
    this.now.style.transform = `translateX(${x}px)`;
    this.now.hidden = x < 0 || x > this.plot.over.clientWidth;
    if (this.hovered === null) this.tell(null);
  }

  // Exact numbers at a time: the hovered one, or the one that is played.
  tell(time) {
    this.hovered = time;
    const at = time ?? this.time;
    const parts = this.lines.slice(0, 8).map((line) => {
      const row = Math.min(nearest(line.t, at), line.values.length - 1);
      const value = line.shift && this.mode === "change" ? line.values[row] - line.values[0] : line.values[row];
      const digits = line.shift && this.mode === "change" ? 6 : line.digits;
      return { line, row, text: exact(value, digits), t: line.t[row] };
    });
    const said = parts.length ? `t = ${exact(parts[0].t, 8)}` : "";
    this.caption.replaceChildren(element("span", { textContent: said }));
    for (const { line, text } of parts) {
      const name = line.shift && this.mode === "change" && !this.data.several ? `Δ${line.label}` : line.label;
      this.caption.append(element("span", {}, this.swatch(line.colour), `${name} `, element("b", { textContent: text })));
    }
  }

  spoken() {
    const ranges = this.lines.slice(0, 8).map(({ label, values }) => {
      let [low, high] = [Infinity, -Infinity];
      for (const x of values) {
        if (x < low) low = x;
        if (x > high) high = x;
      }
      return `${label} from ${exact(low, 6)} to ${exact(high, 6)}`;
    });
    return `${this.chart.title} against time: ${ranges.join("; ")}`;
  }
}

export class PhasePlot extends Plot {
  choose() {
    return this.chart.pairs;
  }

  build() {
    const { host, chart, data } = this;
    this.width = host.clientWidth;
    if (!this.width) return;
    const { columns, label } = this.choices[this.choice];
    const [a, b] = columns;
    this.lines = data.runs.flatMap((run, k) => {
      const table = run.tables[chart.table];
      if (!table || Math.max(a, b) >= table.columns.length) return [];
      table.t ??= table.rows ? Float64Array.from(table.rows, (row) => run.t[row]) : run.t;
      const line = { run: k, label: data.several ? run.label : "", t: table.t, x: table.values[a], y: table.values[b] };
      return [{ ...line, digits: table.digits, colour: this.colourOf(k, 0), ghost: run.ghost }];
    });
    const names = label.split(", ");
    const { range } = this;
    const limits = (axis) => range?.[axis] ?? padded(...extent(this.lines.map((line) => line[axis])));
    this.plot?.destroy();
    const options = {
      mode: 2,
      width: this.width,
      height: HEIGHT,
      legend: { show: false },
      cursor: { drag: { x: true, y: true, setScale: false }, points: { show: false }, bind: { dblclick: () => null } },
      scales: { x: { time: false, range: limits("x") }, y: { range: limits("y") } },
      axes: this.axes(),
      series: [null, ...this.lines.map((line) => ({ paths: (plot) => trace(plot, line), facets: [{ scale: "x", auto: false }, { scale: "y", auto: false }] }))],
      hooks: { setSelect: [(plot) => this.selected(plot)] },
    };
    this.plot = new uPlot(options, [null, ...this.lines.map((line) => [line.x, line.y])], host);
    this.dots = this.lines.map((line) => {
      const dot = element("div", { className: "dot" });
      dot.style.background = line.colour;
      this.plot.over.append(dot);
      return dot;
    });
    this.names = names;
    this.listen(
      this.plot.over,
      (x, y) => this.tell(x === null ? null : this.closest(x, y)),
      (x, y) => this.clock.seek(this.closest(x, y).time),
    );
    this.whole.hidden = !range;
    host.setAttribute("aria-label", `${chart.title}: ${names[1]} against ${names[0]}`);
    this.hovered = null;
    this.show(this.time);
  }

  closest(left, top) {
    let best = { gap: Infinity, time: this.time };
    for (const line of this.lines) {
      for (let i = 0; i < line.x.length; i++) {
        const gap = Math.hypot(this.plot.valToPos(line.x[i], "x") - left, this.plot.valToPos(line.y[i], "y") - top);
        if (gap < best.gap) best = { gap, time: line.t[i] };
      }
    }
    return best;
  }

  selected(plot) {
    const { left, top, width, height } = plot.select;
    if (width < 4 || height < 4) return;
    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.zoom({
      x: [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")],
      y: [plot.posToVal(top + height, "y"), plot.posToVal(top, "y")],
    });
  }

  zoom(range) {
    this.range = range;
    this.build();
  }

  show(time) {
    this.time = time;
    if (!this.plot) return;
    this.lines.forEach((line, k) => {
      const row = Math.min(nearest(line.t, time), line.x.length - 1);
      const [x, y] = [this.plot.valToPos(line.x[row], "x"), this.plot.valToPos(line.y[row], "y")];
      this.dots[k].style.transform = `translate(${x}px, ${y}px)`;
      this.dots[k].hidden = !(x >= 0 && y >= 0 && x <= this.plot.over.clientWidth && y <= this.plot.over.clientHeight);
    });
    if (!this.hovered) this.tell(null);
  }

  tell(hovered) {
    this.hovered = hovered;
    const time = hovered?.time ?? this.time;
    this.caption.replaceChildren(element("span", { textContent: `t = ${exact(time, 8)}` }));
    for (const line of this.lines.slice(0, 6)) {
      const row = Math.min(nearest(line.t, time), line.x.length - 1);
      const text = `${exact(line.x[row], line.digits)}, ${exact(line.y[row], line.digits)}`;
      const name = line.label ? `${line.label} ` : `${this.names.join(", ")} = `;
      this.caption.append(element("span", {}, this.swatch(line.colour), name, element("b", { textContent: text })));
    }
  }
}

// A polyline in the plane, drawn into uPlot's canvas.
function trace(plot, line) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.beginPath();
  ctx.strokeStyle = faint(line.colour, line.ghost);
  ctx.lineWidth = 1.3 * devicePixelRatio;
  ctx.lineJoin = "round";
  for (let i = 0; i < line.x.length; i++) ctx.lineTo(plot.valToPos(line.x[i], "x", true), plot.valToPos(line.y[i], "y", true));
  ctx.stroke();
  ctx.restore();
  return null;
}

function faint(colour, ghost) {
  return ghost ? `${colour}66` : colour;
}

function extent(columns) {
  let [low, high] = [Infinity, -Infinity];
  for (const column of columns) {
    for (const x of column) {
      if (x < low) low = x;
      if (x > high) high = x;
    }
  }
  return [low, high];
}

// A range with room above and below, also where all values are equal.
function padded(low, high) {
  if (!Number.isFinite(low) || !Number.isFinite(high)) return [-1, 1];
  const room = high > low ? 0.06 * (high - low) : Math.abs(low) * 1e-3 || 1;
  return [low - room, high + room];
}

// Numbers beside an axis, with as many digits as their distance asks for.
function labels(splits, step) {
  const largest = Math.max(...splits.map((x) => Math.abs(x ?? 0)));
  let decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  if (Math.abs(step * 10 ** decimals - Math.round(step * 10 ** decimals)) > 1e-6) decimals += 1; // steps of 0.25
  if (largest === 0) return splits.map(() => "0");
  if (!(step > 0)) return splits.map((x) => (x === null ? "" : exact(x, 3)));
  if (largest >= 1e6 || largest < 1e-3) {
    const power = Math.floor(Math.log10(largest) + 1e-9);
    const places = Math.max(0, power + decimals);
    return splits.map((x) => (x === 0 ? "0" : `${shortened((x / 10 ** power).toFixed(Math.min(12, places)))}e${power}`));
  }
  return splits.map((x) => (x === null ? "" : x.toFixed(Math.min(12, decimals)).replace(/^-0(\.0*)?$/, "0")));
}

function shortened(text) {
  return text.includes(".") ? text.replace(/\.?0+$/, "") : text;
}
