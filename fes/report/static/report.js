"use strict";
// Draws the session's signals from the numbers in #session-data. No request leaves this page.
(() => {
  const root = document.documentElement;
  const data = JSON.parse(document.getElementById("session-data").textContent);
  const MISSING = -32768;
  const START_WINDOW_S = 10;
  const SHORTEST_S = 0.2;
  const OVERVIEW_BINS = 1500;
  const PRINT_WIDTH = 690;

  const unpack = (packed) => {
    const text = atob(packed.data);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const view = new DataView(bytes.buffer);
    const values = new Array(bytes.length / 2);
    for (let i = 0; i < values.length; i++) {
      const raw = view.getInt16(2 * i, true);
      values[i] = raw === MISSING ? null : raw * packed.step;
    }
    return values;
  };
  const times = (start, step, pieces) => Float64Array.from(pieces.flatMap(
    ([first, count]) => Array.from({ length: count }, (_, i) => start + (first + i) * step)));

  const place = document.getElementById("charts");
  const widthNow = () => Math.max(280, Math.floor(place.clientWidth));
  const charts = [];
  const whole = [0, Math.max(data.duration_s, SHORTEST_S)];
  let span = [data.opening_s, data.opening_s + Math.min(START_WINDOW_S, whole[1])];
  let overview = null;
  let busy = false;

  // Tells whoever opened the page (a test, a print job) how many plots are on it by now.
  const drawn = new Set();
  const done = (u) => { drawn.add(u); root.dataset.drawn = String(drawn.size); };
  root.dataset.drawn = "0";

  // Phase bands lie behind the curves; only those inside the window are drawn.
  const bands = (foot) => (u) => {
    const { min, max } = u.scales.x;
    const ctx = u.ctx;
    ctx.save();
    for (let i = 0; i < foot.phase.length; i++) {
      if (foot.phase_end_s[i] < min || foot.phase_start_s[i] > max) continue;
      const from = u.valToPos(Math.max(foot.phase_start_s[i], min), "x", true);
      const to = u.valToPos(Math.min(foot.phase_end_s[i], max), "x", true);
      ctx.globalAlpha = foot.phase[i] === 0 ? 0.28 : 0.42;
      ctx.fillStyle = data.phases[foot.phase[i]].color;
      ctx.fillRect(from, u.bbox.top, Math.max(to - from, 1), u.bbox.height);
    }
    ctx.restore();
  };

  // Along the top edge: solid where the sensor was at its limit, hollow where samples are missing.
  const marks = (foot) => (u) => {
    const { min, max } = u.scales.x;
    const ctx = u.ctx, tall = 7 * devicePixelRatio;
    ctx.save();
    ctx.fillStyle = ctx.strokeStyle = "#000";
    for (const one of foot.wrong) {
      if (one.end_s < min || one.start_s > max) continue;
      const from = u.valToPos(Math.max(one.start_s, min), "x", true);
      const wide = Math.max(u.valToPos(Math.min(one.end_s, max), "x", true) - from, 3);
      if (one.kind === "clipped") ctx.fillRect(from, u.bbox.top, wide, tall);
      else ctx.strokeRect(from, u.bbox.top + tall + 2, wide, tall);
    }
    ctx.restore();
  };

  // Moments with a name, upright: where something happened, should have, or did once.
  const moments = (lines) => (u) => {
    const { min, max } = u.scales.x;
    const ctx = u.ctx, dot = devicePixelRatio;
    ctx.save();
    ctx.font = 11 * dot + "px sans-serif";
    ctx.lineWidth = 1.5 * dot;
    for (const one of lines || []) {
      if (one.t_s < min || one.t_s > max) continue;
      const x = u.valToPos(one.t_s, "x", true);
      ctx.strokeStyle = ctx.fillStyle = one.color;
      ctx.setLineDash(one.row ? [4 * dot, 3 * dot] : []);
      ctx.beginPath();
      ctx.moveTo(x, u.bbox.top);
      ctx.lineTo(x, u.bbox.top + u.bbox.height);
      ctx.stroke();
      if (max - min < 5 || (one.always && max - min < 30)) ctx.fillText(one.name, x + 3 * dot, u.bbox.top + (22 + 13 * one.row) * dot);
    }
    ctx.restore();
  };

  const phaseAt = (foot, t) => {
    let low = 0, high = foot.phase.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (foot.phase_start_s[middle] <= t) low = middle; else high = middle - 1;
    }
    return data.phases[foot.phase[low]].name;
  };

  const shown = (digits) => (u, value) => (value == null ? "–" : value.toFixed(digits));

  const add = (title, yLabel, height, x, series, foot, digits, lines) => {
    const box = document.createElement("div");
    box.className = "chart";
    const head = document.createElement("h3");
    head.textContent = title;
    const holder = document.createElement("div");
    holder.setAttribute("role", "img");
    holder.setAttribute("aria-label", title + ", " + yLabel + " over time");
    box.append(head, holder);
    place.append(box);
    const timeValue = (u, t) => (t == null ? "–" : t.toFixed(3) + " s" + (foot ? ", " + phaseAt(foot, t) : ""));
    const chart = new uPlot({
      width: widthNow(),
      height,
      cursor: { sync: { key: "session" }, drag: { x: true, y: false, setScale: false }, points: { size: 6 } },
      select: { show: true },
      scales: { x: { time: false, range: (u, min, max) => [min, max] } },
      axes: [
        { label: foot ? undefined : "time (s)", labelSize: 18, size: 34, stroke: "#1b1f24", grid: { stroke: "#d5dae0" } },
        { label: yLabel, labelSize: 20, size: 58, stroke: "#1b1f24", grid: { stroke: "#d5dae0" } },
      ],
      series: [
        { label: "time", value: timeValue },
        ...series.map((one) => ({
          label: one.name, stroke: one.color, width: one.width || 1.3, value: shown(digits), points: { show: false },
          fill: one.fill, paths: one.stepped ? uPlot.paths.stepped({ align: 1 }) : undefined,
        })),
      ],
      hooks: {
        drawClear: foot ? [bands(foot)] : [],
        draw: [...(foot ? [marks(foot)] : []), moments([...(lines || []), ...(data.marks || [])]), done],
        setSelect: [(u) => {
          if (u.select.width > 4) {
            show(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
            u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
          }
        }],
        ready: [(u) => {
          u.over.addEventListener("dblclick", () => show(whole[0], whole[1]));
          let down = 0;
          u.over.addEventListener("mousedown", (event) => { down = event.clientX; });
          u.over.addEventListener("click", (event) => {
            const left = event.clientX - u.over.getBoundingClientRect().left;
            if (Math.abs(event.clientX - down) < 4) tell(u.posToVal(left, "x"));
          });
        }],
      },
    }, [x, ...series.map((one) => one.values)], holder);
    charts.push(chart);
  };

  // The whole session at a glance; dragging in it picks the window.
  const addOverview = (x, values, color, label) => {
    const per = Math.max(1, Math.ceil(values.length / OVERVIEW_BINS));
    const t = [], y = [];
    for (let i = 0; i < values.length; i += per) {
      let low = null, high = null;
      for (let j = i; j < Math.min(i + per, values.length); j++) {
        const value = values[j];
        if (value == null) continue;
        if (low === null || value < low) low = value;
        if (high === null || value > high) high = value;
      }
      t.push(x[i], x[Math.min(i + per / 2, values.length - 1) | 0]);
      y.push(low, high);
    }
    const box = document.createElement("div");
    box.className = "chart overview";
    box.setAttribute("role", "img");
    box.setAttribute("aria-label", "Whole session, " + label);
    const head = document.createElement("h3");
    head.textContent = "Whole session (" + label + ")";
    box.append(head);
    place.append(box);
    overview = new uPlot({
      width: widthNow(), height: 90, legend: { show: false },
      cursor: { drag: { x: true, y: false, setScale: false }, points: { show: false }, y: false },
      scales: { x: { time: false, range: () => whole } },
      axes: [{ size: 28, stroke: "#1b1f24", grid: { show: false } }, { size: 78, show: true, stroke: "#fff", ticks: { show: false }, grid: { show: false } }],
      series: [{}, { stroke: color, width: 1, points: { show: false } }],
      hooks: {
        setSelect: [(u) => {
          if (busy) return;
          const from = u.posToVal(u.select.left, "x");
          const to = u.posToVal(u.select.left + u.select.width, "x");
          const half = (span[1] - span[0]) / 2;
          if (u.select.width > 4) show(from, to); else show(from - half, from + half);
        }],
        draw: [moments(data.marks), done, () => mark()],
      },
    }, [t, y], box);
  };

  // What was at one instant, and why, as `fes explain` says it.
  const moment = document.getElementById("moment");
  const teller = momentTeller(data);
  const NEAR_S = 2;
  const element = (tag, text, kind) => {
    const made = document.createElement(tag);
    made.textContent = text;
    if (kind) made.className = kind;
    return made;
  };
  function tell(at) {
    if (!moment) return;
    const phaseOf = (name, then = at) => {
      const foot = data.feet.find((one) => one.name === name);
      const i = foot ? foot.phase_end_s.findIndex((end) => end > then) : -1;
      return i < 0 ? null : { number: foot.phase[i], start_s: foot.phase_start_s[i] };
    };
    const lines = [], rows = [];
    const current = data.current;
    const k = Math.round((at - current.start_s) / current.step_s);
    for (const channel of current.channels) {
      const ma = unpack(channel.current_ma)[k];
      lines.push(channel.name + ": " + (ma ? "on, " + ma.toFixed(1) + " mA" : "off" + teller.off(channel.name, phaseOf, at)));
    }
    if (current.channels.length) lines.push(teller.gate(at));
    for (const foot of data.feet) {
      const phase = phaseOf(foot.name);
      const told = teller.foot(foot.name, (then) => phaseOf(foot.name, then)?.start_s ?? null, at);
      if (told) { lines.push(...told.lines); rows.push(...told.rows); }
      else if (phase) lines.push(foot.name + ": " + data.phases[phase.number].name + " since " + phase.start_s.toFixed(3) + " s");
    }
    lines.push(...teller.tuned(at));
    const near = data.notices.filter((one) => one.source !== "tuning" && Math.abs(one.time_s - at) <= NEAR_S);
    for (const one of (data.marks || []).filter((each) => Math.abs(each.t_s - at) <= NEAR_S)) lines.push(one.t_s.toFixed(2) + " s, mark: " + one.name);
    for (const one of near) lines.push(one.time_s.toFixed(2) + " s, " + one.source + ": " + one.text);
    moment.querySelector("h3").textContent = "At " + at.toFixed(3) + " s";
    moment.querySelector("ul").replaceChildren(...lines.map((line) => element("li", line)));
    moment.querySelector("tbody").replaceChildren(...rows.map((row) => {
      const line = element("tr", "", row.asked ? "" : "unused");
      line.append(...row.cells.map((text, i) => element(i ? "td" : "th", text, [3, 7, 8].includes(i) ? "text" : "")));
      return line;
    }));
    moment.querySelector(".scroll").hidden = !rows.length;
    moment.querySelector("code").textContent = "fes explain session.feslog --at " + at.toFixed(3);
    moment.hidden = false;
  }

  const output = document.getElementById("window");
  const slider = document.getElementById("position");

  function show(from, to) {
    const wide = Math.min(Math.max(to - from, SHORTEST_S), whole[1]);
    const middle = (from + to) / 2;
    const start = Math.max(Math.min(middle - wide / 2, whole[1] - wide), 0);
    span = [start, start + wide];
    for (const chart of charts) chart.setScale("x", { min: span[0], max: span[1] });
    output.textContent = span[0].toFixed(1) + " … " + span[1].toFixed(1) + " s";
    const free = whole[1] - wide;
    slider.disabled = free < 1e-6;
    slider.value = free < 1e-6 ? 0 : Math.round((1000 * span[0]) / free);
    mark();
  }

  function mark() {
    if (!overview) return;
    busy = true;
    const left = overview.valToPos(span[0], "x");
    const right = overview.valToPos(span[1], "x");
    overview.setSelect({ left, top: 0, width: Math.max(right - left, 2), height: overview.over.clientHeight }, false);
    busy = false;
  }

  const resize = (width) => {
    for (const chart of charts) chart.setSize({ width, height: chart.height });
    if (overview) { overview.setSize({ width, height: overview.height }); mark(); }
  };

  const move = (share) => { const by = share * (span[1] - span[0]); show(span[0] + by, span[1] + by); };
  const zoom = (factor) => {
    const middle = (span[0] + span[1]) / 2, half = (factor * (span[1] - span[0])) / 2;
    show(middle - half, middle + half);
  };
  const acts = {
    back: () => move(-0.5), on: () => move(0.5), in: () => zoom(0.5), out: () => zoom(2),
    ten: () => show(span[0], span[0] + START_WINDOW_S), all: () => show(whole[0], whole[1]),
  };

  const build = () => {
    for (const foot of data.feet) {
      const x = times(foot.start_s, foot.step_s, foot.pieces);
      const rate = unpack(foot.gyr_degps);
      if (!overview) addOverview(x, rate, foot.color, foot.name + " rotation rate");
      const sign = foot.toe_down_positive ? ", toe down +" : ", sign not known";
      add(foot.name + ": rotation rate", "°/s" + sign, 200, x, [{ name: "rate (°/s)", color: "#1b1f24", values: rate }], foot, 0, foot.moments);
      add(foot.name + ": size of the acceleration", "m/s²", 150, x, [{ name: "acceleration (m/s²)", color: "#1b1f24", values: unpack(foot.acc_mps2) }], foot, 1);
    }
    const current = data.current;
    if (current.channels.length && current.pieces[0][1] > 1) {
      const x = times(current.start_s, current.step_s, current.pieces);
      const series = current.channels.map((channel) => ({
        name: channel.name + " (mA)", color: channel.color, width: 1.8, stepped: true, fill: channel.color + "33",
        values: unpack(channel.current_ma),
      }));
      add("stimulation: commanded current", "mA", 160, x, series, null, 1, current.moments);
    }
  };

  document.getElementById("plots").hidden = false;
  build();
  if (charts.length) {
    document.getElementById("noplots").hidden = true;
    show(span[0], span[1]);
    for (const button of document.querySelectorAll("[data-act]")) button.addEventListener("click", acts[button.dataset.act]);
    slider.addEventListener("input", () => {
      const wide = span[1] - span[0], start = (slider.value / 1000) * (whole[1] - wide);
      show(start, start + wide);
    });
    const near = (t) => show(t - 0.8, t + 0.8);
    for (const link of document.querySelectorAll("[data-at]")) link.addEventListener("click", () => near(Number(link.dataset.at)));
    const asked = /^#at=([\d.]+)$/.exec(location.hash);
    if (asked) { place.closest("details")?.setAttribute("open", ""); near(Number(asked[1])); place.scrollIntoView(); }
    document.addEventListener("keydown", (event) => {
      if (event.target.matches("input, summary, [tabindex], a") || event.ctrlKey || event.metaKey || event.altKey) return;
      const act = { ArrowLeft: "back", ArrowRight: "on", "+": "in", "-": "out" }[event.key];
      if (act) { event.preventDefault(); acts[act](); }
    });
    let width = widthNow();
    window.addEventListener("resize", () => { if (widthNow() !== width) resize((width = widthNow())); });
    window.addEventListener("beforeprint", () => resize(PRINT_WIDTH));
    window.addEventListener("afterprint", () => resize((width = widthNow())));
  } else {
    document.getElementById("plots").hidden = true;
  }
})();
