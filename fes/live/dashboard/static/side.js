// The foot's path seen from the side: the newest strides of each foot, x forward in metres, z up in centimetres.

import { side } from "/static/words.js";

const STRIDES = 5;

export class SideView {
  constructor(canvas) {
    this.canvas = canvas;
    this.empty();
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  empty() {
    this.strides = {};
  }

  add(stride) {
    if (!stride.valid || stride.path_m.length < 4) return;
    const kept = (this.strides[stride.foot] ??= []);
    kept.push(stride.path_m);
    if (kept.length > STRIDES) kept.shift();
  }

  draw() {
    const { canvas } = this;
    const ratio = devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const paths = Object.entries(this.strides);
    let [far, high] = [0.5, 0.1];
    for (const [, kept] of paths)
      for (const path of kept)
        for (let k = 0; k < path.length; k += 2) [far, high] = [Math.max(far, path[k]), Math.max(high, path[k + 1])];
    const box = { left: 46, right: width - 12, top: 8, bottom: height - 34 };
    const x = (m) => box.left + (m / (far * 1.04)) * (box.right - box.left);
    const y = (m) => box.bottom - ((m * 100 + 2) / (high * 112 + 2)) * (box.bottom - box.top);
    pen.font = "12px system-ui, sans-serif";
    pen.lineWidth = 1;
    pen.textAlign = "center";
    for (let m = 0; m <= far; m += far > 0.9 ? 0.25 : 0.1) {
      line(pen, colour("--grid"), [x(m), box.top, x(m), box.bottom]);
      pen.fillStyle = colour("--soft");
      pen.fillText(m.toFixed(far > 0.9 ? 2 : 1), x(m), box.bottom + 14);
    }
    pen.textAlign = "right";
    const step_cm = high > 0.2 ? 10 : 5;
    for (let cm = 0; cm <= high * 112; cm += step_cm) {
      line(pen, cm ? colour("--grid") : colour("--soft"), [box.left, y(cm / 100), box.right, y(cm / 100)]);
      pen.fillStyle = colour("--soft");
      pen.fillText(cm + step_cm > high * 112 ? `${cm} cm` : String(cm), box.left - 5, y(cm / 100) + 4);
    }
    pen.textAlign = "center";
    pen.fillText("forward (m) →", (box.left + box.right) / 2, height - 4);
    for (const [foot, kept] of paths) {
      const which = side(foot);
      kept.forEach((path, at) => {
        const newest = at === kept.length - 1;
        pen.globalAlpha = newest ? 1 : 0.25 + (0.3 * at) / kept.length;
        pen.lineWidth = newest ? 3.5 : 1.5;
        pen.setLineDash(which === "right" && paths.length > 1 ? [7, 4] : []);
        const points = [];
        for (let k = 0; k < path.length; k += 2) points.push(x(path[k]), y(path[k + 1]));
        line(pen, colour(`--${which}`), points);
      });
      pen.globalAlpha = 1;
      pen.setLineDash([]);
    }
    canvas.dataset.drawn = paths.map(([foot, kept]) => `${foot}:${kept.length}`).join(" ");
  }
}

function line(pen, colour, points) {
  pen.strokeStyle = colour;
  pen.beginPath();
  pen.moveTo(points[0], points[1]);
  for (let k = 2; k < points.length; k += 2) pen.lineTo(points[k], points[k + 1]);
  pen.stroke();
}
