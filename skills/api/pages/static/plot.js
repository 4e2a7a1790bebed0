// A plot of numbers over time on a canvas, with a cursor that another canvas above it draws.
import { colour } from "./scene.js";
import { element } from "./site.js";

const HEIGHT = 92;
const EDGE = { left: 44, right: 8, top: 6, bottom: 16 };

export class Plot {
  // `lines` are columns of motions; `end()` is the end of the clock, `ends(motion)` that of a motion on it, `rowOf(motion,
  // at)` the row of a motion at a time, and `scrub(at)` is called with the time of the pointer.
  constructor(place, title, lines, options) {
    Object.assign(this, { lines, ...options });
    [this.below, this.above] = [element("canvas"), element("canvas")];
    this.key = element("ul", { className: "key" });
    this.frame = element("div", { className: "chart" }, this.below, this.above);
    place.append(element("figure", {}, element("figcaption", {}, title), this.frame, this.key));
    const named = lines.length > 4 ? lines.filter((line) => !line.thin) : lines;
    for (const line of named) {
      const sign = element("span", { className: "sign" });
      line.sign = sign;
      this.key.append(element("li", {}, sign, ` ${line.key ?? line.name}`));
    }
    this.frame.addEventListener("pointerdown", (event) => {
      this.frame.setPointerCapture(event.pointerId);
      this.to(event);
    });
    this.frame.addEventListener("pointermove", (event) => this.frame.hasPointerCapture(event.pointerId) && this.to(event));
    this.draw();
  }

  to(event) {
    const frame = this.frame.getBoundingClientRect();
    this.scrub(((event.clientX - frame.left - EDGE.left) / (frame.width - EDGE.left - EDGE.right)) * this.end());
  }

  x(at) {
    return EDGE.left + (at / this.end()) * (this.wide - EDGE.left - EDGE.right);
  }

  // Draw all but the cursor: the least and the greatest number in each column of pixels, so that no peak is lost.
  draw() {
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    this.wide = this.frame.clientWidth;
    if (!this.wide) return;
    for (const one of [this.below, this.above]) [one.width, one.height] = [this.wide * ratio, HEIGHT * ratio];
    const ink = this.below.getContext("2d");
    ink.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.ratio = ratio;
    const [low, high] = this.range ?? this.extent();
    this.y = (value) => EDGE.top + (HEIGHT - EDGE.top - EDGE.bottom) * (1 - (value - low) / (high - low));
    this.ground(ink, low, high);
    for (const line of this.lines) this.curve(ink, line);
  }

  extent() {
    let [low, high] = [this.zero ? 0 : Infinity, -Infinity];
    for (const { values, width, k, scale = 1, limit } of this.lines) {
      for (let i = k; i < values.length; i += width) {
        if (values[i] * scale < low) low = values[i] * scale;
        if (values[i] * scale > high) high = values[i] * scale;
      }
      if (limit !== undefined && limit !== null) [low, high] = [Math.min(low, limit), Math.max(high, limit)];
    }
    if (!(high > low)) return Number.isFinite(low) ? [low - 1, low + 1] : [0, 1];
    return [low, high + 0.05 * (high - low)];
  }

  ground(ink, low, high) {
    const bottom = HEIGHT - EDGE.bottom;
    const [first] = this.motions;
    ink.font = "11px system-ui, sans-serif";
    if (this.stages) {
      first.stages.forEach((stage, i) => {
        const [from, to] = [this.x(Math.max(0, stage.start_s - first.start_s)), this.x(Math.min(this.end(), stage.end_s - first.start_s))];
        ink.fillStyle = colour("sunk");
        if (i % 2 === 0) ink.fillRect(from, EDGE.top, to - from, bottom - EDGE.top);
        ink.fillStyle = colour("soft");
        ink.textAlign = "left";
        if (ink.measureText(stage.name).width < to - from - 4) ink.fillText(stage.name, from + 3, EDGE.top + 10);
      });
    }
    this.marks.forEach(([from, to], i) => {
      const [left, right] = [from, to].map((at) => this.x(Math.max(0, Math.min(this.end(), at - first.start_s))));
      ink.fillStyle = colour("reward");
      ink.globalAlpha = 0.3;
      ink.fillRect(left, EDGE.top, Math.max(2, right - left), bottom - EDGE.top);
      ink.globalAlpha = 1;
      ink.fillStyle = colour("ink");
      ink.textAlign = "left";
      ink.fillText(`${i + 1}`, left + 2, bottom - 3);
    });
    ink.fillStyle = colour("strong");
    ink.globalAlpha = 0.35;
    for (const [down, up] of first.clutch_s) ink.fillRect(this.x(down - first.start_s), EDGE.top, Math.max(1, this.x(up - first.start_s) - this.x(down - first.start_s)), bottom - EDGE.top);
    ink.globalAlpha = 1;
    ink.fillStyle = colour("soft");
    ink.strokeStyle = colour("line");
    ink.lineWidth = 1;
    ink.beginPath();
    for (const [value, place] of [[low, bottom], [high, EDGE.top + 8]]) {
      ink.textAlign = "right";
      ink.fillText(Math.abs(value) >= 100 ? value.toFixed(0) : value.toFixed(1), EDGE.left - 5, place);
    }
    ink.moveTo(EDGE.left, bottom);
    ink.lineTo(this.wide - EDGE.right, bottom);
    const step = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300].find((one) => this.end() / one <= this.wide / 70) ?? 600;
    ink.textAlign = "center";
    for (let at = Math.ceil(first.start_s / step) * step; at <= first.start_s + this.end(); at += step) {
      ink.moveTo(this.x(at - first.start_s), bottom);
      ink.lineTo(this.x(at - first.start_s), bottom + 3);
      ink.fillText(`${Math.round(at * 10) / 10} s`, this.x(at - first.start_s), HEIGHT - 3);
    }
    ink.stroke();
  }

  curve(ink, { motion, values, width, k, scale = 1, colour: name, dashed, thin, limit, sign }) {
    if (sign) sign.style.borderTop = `3px ${dashed ? "dashed" : "solid"} ${colour(name)}`;
    ink.strokeStyle = colour(name);
    ink.lineWidth = thin ? 0.9 : 1.5;
    ink.setLineDash(dashed ? [5, 3] : []);
    ink.beginPath();
    let open = false;
    const last = Math.floor(this.wide - EDGE.right);
    for (let px = EDGE.left; px <= last; px += 1) {
      const span = [px, px + 1].map((one) => ((one - EDGE.left) / (this.wide - EDGE.left - EDGE.right)) * this.end());
      if (span[0] > this.ends(motion)) break;
      const [from, to] = span.map((at) => Math.floor(this.rowOf(motion, Math.min(at, this.end()))));
      let [low, high] = [Infinity, -Infinity];
      for (let i = from; i <= Math.max(from, to - 1); i += 1) {
        const value = values[i * width + k] * scale;
        if (value < low) low = value;
        if (value > high) high = value;
      }
      if (low > high) {
        open = false;
        continue;
      }
      if (open) ink.lineTo(px, this.y(low));
      else ink.moveTo(px, this.y(low));
      if (high > low) ink.lineTo(px, this.y(high));
      open = true;
    }
    ink.stroke();
    ink.setLineDash([]);
    if (limit === undefined || limit === null) return;
    ink.setLineDash([2, 4]);
    ink.beginPath();
    ink.moveTo(EDGE.left, this.y(limit));
    ink.lineTo(this.wide - EDGE.right, this.y(limit));
    ink.stroke();
    ink.setLineDash([]);
  }

  // Draw the cursor, with a dot on each line.
  mark(rows, now) {
    if (!this.wide) return;
    const ink = this.above.getContext("2d");
    ink.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    if (this.marked !== undefined) ink.clearRect(this.marked - 6, 0, 12, HEIGHT);
    const x = (this.marked = this.x(now));
    ink.fillStyle = colour("ink");
    ink.fillRect(x - 0.5, EDGE.top, 1, HEIGHT - EDGE.top - EDGE.bottom);
    for (const { motion, values, width, k, scale = 1, colour: name, thin } of this.lines) {
      const value = values[Math.round(rows.get(motion)) * width + k] * scale;
      if (thin || Number.isNaN(value)) continue;
      ink.fillStyle = colour(name);
      ink.beginPath();
      ink.arc(x, this.y(value), 3, 0, 7);
      ink.fill();
    }
  }
}
