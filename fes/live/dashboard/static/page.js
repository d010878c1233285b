// Ties the connection to what is shown and to the buttons.

import { EnvelopeChart, StrideChart } from "/static/charts.js";
import { Link } from "/static/link.js";
import { SideView } from "/static/side.js";
import { clock, foot, ground, make, number, percent, phase, PHASES, side, STATES, unit, write } from "/static/words.js";

const $ = (id) => document.getElementById(id);
const STOP_WITHIN_MS = 500;
const STALE_MS = 500;
const OLD_MS = 40; // the gate takes no older sample
const SILENT_MS = 1000;
const SAID_MS = 5000;
const ANSWER_MS = 10_000; // later the session takes no yes
const ROWS = 10;
const MARKS_KEPT = 6; // to be set again by one press
const NUMBERED = /^mark \d+$/;
const CURRENT = ["armed", "running"];
const BESIDE = "Use the SPACE key at the computer, or the stop button beside you.";

const view = { about: null, status: null, role: "nobody", stopAsked: 0, lost: "", refused: "", ended: "", asked: 0, said: "", sent: {} };
const sideView = new SideView($("side"));
const lengths = new StrideChart($("length"), "stride_length_m", 1, 0.8, 2);
const clearances = new StrideChart($("clearance"), "clearance_m", 100, 10, 1);
let envelope = null;

// --- what comes ---------------------------------------------------------------------------------------

function hello(about) {
  view.refused = "";
  view.lost = "";
  if (view.about) empty();
  else {
    view.about = about;
    document.body.classList.add(about.mode); // live, exercise or replay
    write($("session-name"), `${about.name}${about.mode === "replay" ? " (replay)" : ""}`);
    write($("most"), about.mode === "replay" ? "" : ` of at most ${percent(about.most_intensity)}`);
    $("ground").hidden = about.mode !== "live";
    $("mark").hidden = about.mode === "replay";
    document.title = `FES: ${about.name}`;
    envelope = new EnvelopeChart($("envelope"), about.channels);
    const shown = about.channels[0];
    write($("shaded"), shown ? `shaded: swing of the ${foot(shown.foot).toLowerCase()}` : "");
    $("envelope-panel").hidden = !shown;
  }
  draw();
}

/** The connection was lost and is there again: everything that is kept comes anew. */
function empty() {
  for (const each of [sideView, lengths, clearances, envelope]) each.empty();
  for (const id of ["strides", "notes"]) $(id).replaceChildren();
}

function frame(said) {
  view.lost = "";
  view.role = said.role;
  if (said.ended) view.ended = said.ended;
  for (const stride of said.strides ?? []) {
    for (const each of [sideView, lengths, clearances]) each.add(stride);
    row(stride);
  }
  for (const [ms, severity, text] of said.notes ?? []) note(ms, severity, text);
  for (const [ms, which, name] of said.phases ?? []) if (which === view.about.channels[0]?.foot) envelope.phase(ms, name);
  envelope.add(said.sent ?? [], said.answered ?? []);
  for (const [, channel, ma] of said.sent ?? []) view.sent[channel] = ma;
  if (said.strides) for (const each of [sideView, lengths, clearances]) each.draw();
  if (said.status) {
    view.status = said.status;
    if (view.ended) view.lost = "";
    else if (said.age_ms > STALE_MS) view.lost = `Nothing is heard of the session for ${(said.age_ms / 1000).toFixed(1)} s.`;
    envelope.draw(said.status.t_ms);
    feet(said.status);
    timing(said.status, said.browsers);
  }
  draw();
}

function row(stride) {
  const cells = stride.valid
    ? [number(stride.stride_length_m, 2), number(stride.clearance_m === null ? null : 100 * stride.clearance_m, 1),
       number(stride.toe_clearance_m === null ? null : 100 * stride.toe_clearance_m, 1), number(stride.speed_mps, 2)]
    : [`not used: ${stride.reason}`];
  const line = make("tr", { class: `${side(stride.foot)} ${stride.valid ? "" : "unused"}`, "data-stride": JSON.stringify(stride) });
  line.append(make("td", {}, foot(stride.foot)), make("td", {}, String(stride.number)));
  cells.forEach((text) => line.append(make("td", stride.valid ? {} : { colspan: "4" }, text)));
  $("strides").prepend(line);
  while ($("strides").children.length > ROWS) $("strides").lastChild.remove();
}

function note(ms, severity, text) {
  if (severity === "info" && text.startsWith("state ")) return; // the head of the page says it
  if (severity === "mark" && !NUMBERED.test(text)) again(text);
  const like = `${severity} ${text.replace(/\d+(\.\d+)?/g, "#")}`; // but for its numbers the same as one of the newest
  const before = ["info", "warning"].includes(severity) && [...$("notes").children].slice(0, 6).find((each) => each.dataset.like === like);
  const times = before ? Number(before.dataset.times) + 1 : 1;
  if (before) before.remove();
  const told = times > 1 ? `${text} (${times} times)` : text;
  $("notes").prepend(make("li", { class: severity, "data-like": like, "data-times": times }, make("time", {}, clock(ms)), told));
  while ($("notes").children.length > 40) $("notes").lastChild.remove();
}

/** A button that sets the same mark once more; the newest comes first. */
function again(text) {
  for (const each of [...$("marked").children]) if (each.textContent === text) each.remove();
  const button = make("button", { type: "button", title: text }, text);
  button.addEventListener("click", () => link.send({ ask: "mark", text }));
  $("marked").prepend(button);
  while ($("marked").children.length > MARKS_KEPT) $("marked").lastChild.remove();
}

// --- what is shown ------------------------------------------------------------------------------------

function draw() {
  const { status } = view;
  const blind = view.refused || view.lost;
  const [word, text] = view.ended ? ["ENDED", view.ended]
    : blind ? ["NO CONNECTION", view.refused || "What you see may be old."]
    : status ? words(status.state) : ["CONNECTED", "Waiting for the session."];
  document.body.dataset.state = view.ended ? "ended" : blind ? "lost" : status?.state ?? "unknown";
  write($("state-word"), word);
  write($("state-text"), text);
  faults(status, blind || view.ended);
  const on = Boolean(status?.on) && !blind && !view.ended;
  $("current").className = on ? "on" : "off";
  write($("current"), on ? "⚡ Current ON" : blind && !view.ended ? "Current unknown" : "No current");
  alarm(blind);
  write($("link-text"), view.role === "control" ? "this page controls" : view.role === "watch" ? "this page watches" : "no valid link");
  document.body.classList.toggle("watching", view.role === "watch");
  write($("message"), view.said || status?.message || "");
  write($("intensity"), status ? percent(status.intensity) : "–");
  buttons(status, Boolean(blind || view.ended));
}

function words(state) {
  if (view.about?.mode === "exercise" && state === "armed") return ["EXERCISE", "Bursts come and go by the clock, above intensity 0."];
  return STATES[state] ?? [state.toUpperCase(), ""];
}

/** Right below the state: what is wrong and what to do about it; what to know though nothing is, above all else. */
function faults(status, old) {
  const fault = !old && status?.fault && status.fault !== "emergency stop" ? status.fault : "";
  $("fault").hidden = !fault;
  write($("fault-text"), fault ? `${fault}.` : "");
  write($("remedy"), fault && status.remedy ? `What to do: ${status.remedy}` : "");
  const notices = status?.notices ?? [];
  $("notices").hidden = !notices.length;
  while ($("notices").children.length > notices.length) $("notices").lastChild.remove();
  notices.forEach((text, at) => write($("notices").children[at] ?? $("notices").appendChild(make("li")), text));
}

function alarm(blind) {
  const late = view.stopAsked && performance.now() - view.stopAsked > STOP_WITHIN_MS;
  if (view.status?.state === "stopped" || view.ended) view.stopAsked = 0;
  const text = view.stopAsked && late ? `STOP is not confirmed. ${BESIDE}`
    : view.refused ? `${view.refused} Open the newest link: it is in the file page.url of the session's folder. STOP works here all the same.`
    : blind && !view.ended ? `${blind} STOP here may not get through. ${BESIDE}` : "";
  $("alarm").hidden = !text;
  write($("alarm"), text);
  $("stop").classList.toggle("pressed", Boolean(view.stopAsked));
}

function buttons(status, blind) {
  const state = status?.state ?? "";
  const current = CURRENT.includes(state);
  const controls = view.role === "control";
  write($("pause"), state === "paused" ? "Go on" : "Pause");
  $("pause").disabled = blind || !(current || (state === "paused" && controls));
  $("arm").disabled = blind || !controls || !["shadow", "stopped", "fault"].includes(state);
  $("disarm").disabled = blind || !(current || state === "paused");
  for (const each of document.querySelectorAll("#mark input, #mark button")) each.disabled = blind || !status;
  for (const id of ["incline", "set-incline", "free"]) $(id).disabled = blind || !controls || !status;
  $("down").disabled = blind || !status || status.intensity <= 0;
  $("up").disabled = blind || !controls || !(current || state === "shadow") || status.intensity >= view.about.most_intensity - 1e-6;
}

/** What stimulates first: the feet that channels follow, with their currents; then other feet; then one line of the rest. */
function feet(status) {
  const worn = status.feet;
  const driving = new Map(view.about.feet.map((name) => {
    const shank = `${side(name)}_shank`;
    const sensor = worn[name]?.phase || !worn[shank]?.phase ? name : shank;
    return [sensor, view.about.channels.filter((each) => each.foot === name)];
  }));
  const others = Object.keys(worn).sort().filter((sensor) => worn[sensor].phase && !driving.has(sensor));
  const shown = [...driving.keys(), ...others];
  for (const card of [...$("feet").children]) if (!shown.includes(card.dataset.sensor)) card.remove();
  for (const sensor of shown) {
    const now = worn[sensor];
    const card = $(`foot-${sensor}`) ?? $("feet").appendChild(footCard(sensor, driving.get(sensor) ?? []));
    const set = (what, text) => write(card.querySelector(`.${what}`), text);
    const seen = now && now.age_ms <= SILENT_MS ? now.phase : "";
    set("walks", !seen ? "phase not known" : now.walking ? "walking" : "not walking");
    set("phase", seen ? phase(seen) : "–");
    for (const each of card.querySelectorAll(".phases li")) each.classList.toggle("now", each.dataset.phase === seen);
    set("strides", String(now?.strides ?? "–"));
    set("length", unit(now?.stride_length_m, "m"));
    set("speed", unit(now?.speed_mps, "m/s"));
    set("age", !now ? "none" : rate(now));
    card.querySelector(".age").classList.toggle("bad", !now || now.age_ms > OLD_MS);
    for (const each of driving.get(sensor) ?? []) {
      const ma = view.sent[each.number] ?? 0;
      const tuned = status.tuning?.[each.number] ?? { mode: "off" };
      write($(`sent-${each.number}`), `${ma.toFixed(1)} mA`);
      write($(`set-${each.number}`), tuned.mode === "off" ? ` of ${each.current_ma.toFixed(1)}` : ` of ${parseFloat(tuned.now).toFixed(1)}, by tuning`);
      write($(`tuned-${each.number}`), tuning(tuned));
      card.querySelector(`[data-channel="${each.number}"]`).classList.toggle("on", ma > 0);
    }
  }
  $("roles").dataset.cards = Math.min(shown.length, 3);
  const rest = Object.keys(worn).sort().filter((sensor) => !shown.includes(sensor));
  $("others").hidden = !rest.length;
  write($("others"), `Other sensors: ${rest.map((sensor) => `${foot(sensor).toLowerCase()} ${rate(worn[sensor])}`).join(" · ")}`);
  $("others").classList.toggle("bad", rest.some((sensor) => worn[sensor].age_ms > OLD_MS));
}

/** What the tuning does, and which key of the terminal answers it: the page has no button for that. */
function tuning(tuned) {
  if (tuned.mode === "off") return "";
  if (tuned.frozen) return `Tuning is frozen: ${tuned.frozen}. In the terminal g goes on.`;
  if (tuned.suggestion) return `Tuning suggests ${tuned.suggestion}. In the terminal y accepts.`;
  return tuned.mode === "act" ? "Tuning changes the current by itself; f in the terminal freezes it." : "Tuning suggests, and changes nothing by itself.";
}

const rate = (now) => (now.age_ms > SILENT_MS ? "silent" : `${now.rate_hz.toFixed(0)} Hz`);

function footCard(sensor, channels) {
  const card = make("section", { class: `foot ${side(sensor)} ${channels.length ? "drives" : ""}`, id: `foot-${sensor}`, "data-sensor": sensor });
  card.append(make("h2", {}, foot(sensor), make("small", { class: "walks" })));
  for (const each of channels) {
    const key = make("span", { class: "key" });
    const [name, dash] = EnvelopeChart.line(view.about.channels.indexOf(each));
    key.style.borderTopColor = `var(${name})`;
    key.classList.toggle("dashed", dash.length > 0);
    card.append(make("p", { class: "channel", "data-channel": each.number },
      make("span", { class: "named" }, key, each.name),
      make("span", {}, make("b", { id: `sent-${each.number}` }), make("small", { id: `set-${each.number}` }))), make("p", { class: "tuned", id: `tuned-${each.number}` }));
  }
  const numbers = make("dl", { class: "numbers" });
  for (const [key, label] of [["strides", "strides"], ["length", "last length"], ["speed", "speed"], ["age", "sensor"]])
    numbers.append(make("div", {}, make("dt", {}, label), make("dd", { class: key }, "–")));
  const bar = make("ol", { class: "phases" });
  for (const [key, label] of PHASES) bar.append(make("li", { "data-phase": key }, label));
  card.append(make("p", { class: "phase" }), numbers, bar);
  return card;
}

function timing(status, browsers) {
  const belt = status.belt_speed_mps;
  const rows = [
    ["Sample to command, median", unit(status.latency_p50_ms, "ms")],
    ["Sample to command, 99 % within", unit(status.latency_p99_ms, "ms")],
    ["Loop woken late, 99 % within", unit(status.lateness_p99_ms, "ms")],
    ["Stimulator", status.stimulator || "–"],
    ["Treadmill", belt === null ? "–" : `${belt.toFixed(2)} m/s`],
    ["Ground", ground(status.incline_percent)],
    ["Samples so far", String(status.samples)],
    ["Session time", clock(status.t_ms)],
    ["Browsers on this page", String(browsers)],
  ];
  const list = $("timing");
  if (!list.children.length) for (const [name] of rows) list.append(make("dt", {}, name), make("dd"));
  rows.forEach(([, value], at) => write(list.children[2 * at + 1], value));
}

// --- what is pressed ----------------------------------------------------------------------------------

const link = new Link({
  hello,
  frame,
  said,
  question,
  refused: (why) => { view.refused = why; draw(); },
  lost: () => { if (!view.ended && !view.refused) { view.lost = "The connection to the session is lost."; draw(); } },
});

function said(text) {
  $("question").hidden = true;
  view.said = text;
  draw();
  clearTimeout(view.forget);
  view.forget = setTimeout(() => { view.said = ""; }, SAID_MS);
}

function stop(event) {
  event.preventDefault();
  $("question").hidden = true;
  link.stop();
  view.stopAsked = performance.now();
  draw();
  setTimeout(draw, STOP_WITHIN_MS + 20);
}

function question(asked) {
  write($("question-text"), asked.text);
  write($("yes"), { up: "Yes, raise", arm: "Yes, arm" }[asked.ask] ?? "Yes, go on");
  $("question").hidden = false;
  $("question").dataset.id = asked.id;
  view.asked = performance.now();
  setTimeout(() => {
    if (!$("question").hidden && $("question").dataset.id === String(asked.id)) said("No answer within 10 s: nothing was done.");
  }, ANSWER_MS);
}

$("stop").addEventListener("pointerdown", stop); // when it goes down, not when it comes up
$("stop").addEventListener("click", (event) => { if (event.detail === 0) stop(event); });
document.addEventListener("keydown", (event) => { if (event.key === " ") stop(event); }, true);
$("yes").addEventListener("click", () => {
  if (performance.now() - view.asked < 300) return; // a second tap of the one that asked
  $("question").hidden = true;
  link.send({ confirm: $("question").dataset.id });
});
$("no").addEventListener("click", () => { $("question").hidden = true; });
for (const what of ["arm", "disarm", "up", "down"]) $(what).addEventListener("click", () => link.send({ ask: what }));
$("pause").addEventListener("click", () => link.send({ ask: view.status?.state === "paused" ? "resume" : "pause" }));
$("ground").addEventListener("submit", (event) => {
  event.preventDefault();
  link.send({ ask: "ground", value: $("incline").valueAsNumber });
});
$("free").addEventListener("click", () => link.send({ ask: "ground_free" }));
$("mark").addEventListener("submit", (event) => {
  event.preventDefault();
  link.send({ ask: "mark", text: $("mark-text").value.replaceAll("_", " ") });
  $("mark-text").value = "";
  $("mark-text").blur();
});
