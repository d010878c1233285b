"use strict";
// Turns the three-dimensional figures. Without this script they stand as they were drawn.
(() => {
  const data = JSON.parse(document.getElementById("session-data").textContent);
  const WIDTH = 640, HEIGHT = 340, MARGIN = 22, STEP_DEG = 10;
  const RAD = Math.PI / 180;

  for (const one of data.spaces) {
    const svg = [...document.querySelectorAll("svg.space")].find((each) => each.dataset.space === one.key);
    if (!svg) continue;
    const paths = svg.querySelectorAll("path"), texts = svg.querySelectorAll("text");
    const start = [one.azimuth_deg, one.elevation_deg];
    let azimuth = start[0], elevation = start[1];

    const flat = (x, y, z) => {
      const a = azimuth * RAD, e = elevation * RAD;
      const away = x * Math.sin(a) + y * Math.cos(a);
      return [x * Math.cos(a) - y * Math.sin(a), -(z * Math.cos(e) + away * Math.sin(e))];
    };
    const draw = () => {
      const lines = one.lines.map(([x, y, z]) => x.map((_, i) => flat(x[i], y[i], z[i])));
      const words = one.texts.map((place) => flat(...place));
      const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
      for (const point of [...lines.flat(), ...words]) {
        for (const k of [0, 1]) { low[k] = Math.min(low[k], point[k]); high[k] = Math.max(high[k], point[k]); }
      }
      const scale = Math.min((WIDTH - 4 * MARGIN) / Math.max(high[0] - low[0], 1e-9), (HEIGHT - 2 * MARGIN) / Math.max(high[1] - low[1], 1e-9));
      const middle = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
      const place = ([x, y]) => [(x - middle[0]) * scale + WIDTH / 2, (y - middle[1]) * scale + HEIGHT / 2];
      lines.forEach((line, i) => paths[i].setAttribute("d", "M" + line.map((p) => place(p).map((v) => v.toFixed(1)).join(" ")).join("L")));
      words.forEach((at, i) => {
        const [x, y] = place(at);
        texts[i].setAttribute("x", x.toFixed(1));
        texts[i].setAttribute("y", y.toFixed(1));
      });
    };
    const turn = (by, up) => {
      azimuth = (azimuth + by) % 360;
      elevation = Math.min(Math.max(elevation + up, 0), 90);
      draw();
    };
    const look = (a, e) => { azimuth = a; elevation = e; draw(); };

    svg.setAttribute("tabindex", "0");
    svg.setAttribute("aria-label", svg.getAttribute("aria-label") + ". Arrow keys turn it, Home turns it back.");
    svg.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [STEP_DEG, 0], ArrowRight: [-STEP_DEG, 0], ArrowUp: [0, STEP_DEG], ArrowDown: [0, -STEP_DEG] }[event.key];
      if (by) turn(...by); else if (event.key === "Home") look(...start); else return;
      event.preventDefault();
    });
    let held = null;
    svg.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; svg.setPointerCapture(event.pointerId); });
    svg.addEventListener("pointermove", (event) => {
      if (!held) return;
      turn(-0.5 * (event.clientX - held[0]), 0.4 * (event.clientY - held[1]));
      held = [event.clientX, event.clientY];
    });
    for (const end of ["pointerup", "pointercancel"]) svg.addEventListener(end, () => { held = null; });

    const box = document.createElement("div");
    box.className = "controls turn";
    box.setAttribute("role", "group");
    box.setAttribute("aria-label", "Turn the figure");
    const acts = [
      ["◀", "Turn to the left", () => turn(STEP_DEG, 0)], ["▶", "Turn to the right", () => turn(-STEP_DEG, 0)],
      ["▲", "Look more from above", () => turn(0, STEP_DEG)], ["▼", "Look more from the side", () => turn(0, -STEP_DEG)],
      ["side", "Look from the side", () => look(-90, 0)], ["above", "Look from above", () => look(-90, 90)],
      ["behind", "Look from behind", () => look(0, 8)], ["reset", "As at first", () => look(...start)],
    ];
    for (const [text, label, act] of acts) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = text;
      button.title = label;
      button.setAttribute("aria-label", label);
      button.addEventListener("click", act);
      box.append(button);
    }
    svg.after(box);
    window.addEventListener("beforeprint", () => look(...start));
  }
})();
