// The charts over strides and over time.

import { side } from "/static/words.js";

const { uPlot } = window;
const SHOWN = 40; // strides
const SPAN_S = 10;
const LINES = [["--ink", []], ["--left", [8, 4]], ["--right", [3, 3]], ["--given", [12, 3, 3, 3]]];

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function fitted(element, chart) {
  const fit = () => chart.setSize({ width: element.clientWidth, height: element.clientHeight });
  new ResizeObserver(fit).observe(element);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => chart.redraw());
  fit();
}

function axis(more) {
  const line = { stroke: () => colour("--grid"), width: 1 };
  return { stroke: () => colour("--soft"), grid: line, ticks: line, font: "12px system-ui, sans-serif", ...more };
}

/** One number of each stride, by the stride's number; a stride that was not measured is a gap. */
export class StrideChart {
  constructor(element, key, scale, most, digits) {
    Object.assign(this, { key, scale, element });
    this.empty();
    const series = (name) => ({
      label: `${name} foot`,
      stroke: () => colour(`--${name}`),
      width: 2,
      dash: name === "right" ? [7, 4] : [],
      spanGaps: false,
      points: { show: true, size: 8, width: 2, fill: () => colour(name === "right" ? "--card" : "--left") },
      value: (_, value) => (value === null ? "–" : value.toFixed(digits)),
    });
    this.chart = new uPlot(
      {
        width: element.clientWidth || 300,
        height: element.clientHeight || 160,
        cursor: { show: false },
        legend: { show: false },
        scales: {
          x: { time: false, range: (_, low, high) => [Math.max((high ?? 1) - SHOWN, 0), Math.max(high ?? 1, 10) + 1] },
          y: { range: (_, low, high) => [0, Math.max(most, (high ?? 0) * 1.15)] },
        },
        series: [{ label: "stride" }, series("left"), series("right")],
        axes: [axis({ size: 30, incrs: [1, 2, 5, 10, 20] }), axis({ size: 44 })],
      },
      [[], [], []],
      element,
    );
    fitted(element, this.chart);
  }

  empty() {
    this.feet = {};
  }

  add(stride) {
    const value = stride.valid && stride[this.key] !== null ? stride[this.key] * this.scale : null;
    ((this.feet[side(stride.foot)] ??= new Map())).set(stride.number, value);
  }

  draw() {
    const of = (name) => this.feet[name] ?? new Map();
    const numbers = [...new Set([...of("left").keys(), ...of("right").keys()])].sort((a, b) => a - b).slice(-SHOWN);
    for (const each of Object.values(this.feet)) for (const at of each.keys()) if (at < numbers[0]) each.delete(at);
    const values = (name) => numbers.map((at) => of(name).get(at) ?? null);
    this.chart.setData([numbers, values("left"), values("right")]);
    for (const [at, name] of [[1, "left"], [2, "right"]])
      if (this.chart.series[at].show !== Boolean(this.feet[name])) this.chart.setSeries(at, { show: Boolean(this.feet[name]) });
    this.element.dataset.drawn = String(numbers.length);
  }
}

/** Current of each channel over the last seconds: sent as a line, what the stimulator says it delivers as dots. */
export class EnvelopeChart {
  constructor(element, channels) {
    this.channels = channels;
    this.element = element;
    this.empty();
    const most = Math.max(10, ...channels.map((each) => each.current_ma));
    const series = channels.flatMap((each, at) => {
      const [name, dash] = EnvelopeChart.line(at);
      return [
        { label: "answered", stroke: () => colour("--given"), width: 0, paths: () => null, points: { show: true, size: 5, width: 1, fill: () => colour("--given") } },
        { label: each.name, stroke: () => colour(name), width: 2, dash, points: { show: false }, paths: uPlot.paths.stepped({ align: 1 }) },
      ];
    });
    this.chart = new uPlot(
      {
        width: element.clientWidth || 600,
        height: element.clientHeight || 160,
        cursor: { show: false },
        legend: { show: false },
        scales: { x: { time: false, range: () => [this.now - SPAN_S, this.now] }, y: { range: (_, __, high) => [0, Math.max(most, high ?? 0) * 1.1] } },
        series: [{}, ...series],
        axes: [axis({ size: 30, values: (_, ticks) => ticks.map((t) => { const s = Math.round(t - this.now); return s ? `${s} s` : "now"; }), splits: () => [-10, -8, -6, -4, -2, 0].map((s) => this.now + s) }), axis({ size: 44 })],
        hooks: { drawClear: [(chart) => this.shade(chart)] },
      },
      this.rows,
      element,
    );
    this.now = 0;
    fitted(element, this.chart);
  }

  empty() {
    this.swings = [];
    this.rows = [[], ...this.channels.flatMap(() => [[], []])];
    this.last = this.channels.flatMap(() => [null, null]);
  }

  static line(at) {
    return LINES[at % LINES.length];
  }

  take(kind, items) {
    const offset = kind === "sent" ? 1 : 0; // the line is drawn over the dots
    return items.flatMap(([ms, channel, ma]) => {
      const at = this.channels.findIndex((each) => each.number === channel);
      return at < 0 ? [] : [[ms / 1000, 2 * at + offset, ma]];
    });
  }

  /** The swings of one foot, shaded: [from s, to s or null while it lasts]. */
  phase(ms, name) {
    const open = this.swings.at(-1);
    if (open && open[1] === null) open[1] = ms / 1000;
    if (name === "swing") this.swings.push([ms / 1000, null]);
    if (this.swings.length > 20) this.swings.shift();
  }

  add(sent, answered) {
    const fresh = [...this.take("sent", sent), ...this.take("answered", answered)].sort((a, b) => a[0] - b[0]);
    for (const [t, at, ma] of fresh) {
      this.rows[0].push(Math.max(t, this.rows[0].at(-1) ?? t));
      this.last = this.last.map((value, k) => (k % 2 ? value : null)); // an answer is a dot, not a level
      this.last[at] = ma;
      this.last.forEach((value, k) => this.rows[k + 1].push(value));
    }
  }

  draw(ms) {
    this.now = ms / 1000;
    const old = this.rows[0].findIndex((t) => t >= this.now - SPAN_S - 0.5);
    const cut = old < 0 ? this.rows[0].length : old;
    if (cut > 50) for (const row of this.rows) row.splice(0, cut);
    this.chart.setData(this.rows);
    this.element.dataset.drawn = String(this.rows[0].length);
  }

  shade(chart) {
    const { ctx, bbox } = chart;
    ctx.save();
    ctx.fillStyle = colour("--shade");
    for (const [from, to] of this.swings) {
      const [a, b] = [from, to ?? this.now].map((t) => Math.min(Math.max(chart.valToPos(t, "x", true), bbox.left), bbox.left + bbox.width));
      if (b > a) ctx.fillRect(a, bbox.top, b - a, bbox.height);
    }
    ctx.restore();
  }
}
