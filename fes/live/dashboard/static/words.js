// What the page calls things, and how it writes numbers.

export const STATES = {
  off: ["WARMING UP", "No stimulation yet."],
  shadow: ["WATCHING ONLY", "Steps are recognised; no current flows. Not armed."],
  armed: ["ARMED", "Current is allowed. Waiting for steps."],
  running: ["WALKING", "Armed: each step is stimulated."],
  paused: ["PAUSED", "No current. The intensity is kept."],
  stopped: ["EMERGENCY STOP", "Everything is off. To go on: the patient stands, then Arm; the intensity begins at 0 %."],
  fault: ["FAULT", "Everything is off until it is armed again by hand."],
};

export const PHASES = [
  ["stance", "Stance"],
  ["pre_swing", "Pre-swing"],
  ["swing", "Swing"],
  ["loading_response", "Loading"],
];

export const phase = (name) => (PHASES.find(([key]) => key === name) ?? [name, name.replaceAll("_", " ")])[1];

export const number = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));

export const unit = (value, name) => (value === null || value === undefined ? "–" : `${value.toFixed(2)} ${name}`);

export const percent = (value) => `${Math.round(100 * value)} %`;

/** What is walked on, from its incline in percent; null: nobody knows. */
export const ground = (percent) => (percent === null ? "stairs or ramps" : percent ? `${percent > 0 ? "+" : "−"}${Math.abs(percent)} %` : "level");

export const foot = (name) => name.replaceAll("_", " ").replace(/^./, (letter) => letter.toUpperCase());

export const side = (name) => (name.startsWith("left") ? "left" : "right");

/** Time of the session as m:ss.s, from its beginning. */
export function clock(ms) {
  const s = Math.max(ms, 0) / 1000;
  return `${Math.floor(s / 60)}:${(s % 60).toFixed(1).padStart(4, "0")}`;
}

/** Set text only where it differs: the browser has less to do, a reader less to hear. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function make(name, attributes = {}, ...inside) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...inside);
  return element;
}
