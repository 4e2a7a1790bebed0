// A 3-D view, rotated by mouse, touch, keys and buttons. Coordinates are mm.
import { Renderer } from "./webgl.js";
import { say } from "./site.js";

const colours = new Map();
export function colour(name) {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colours.get(name);
}
document.addEventListener("theme", () => colours.clear());

function rgb(name) {
  if (typeof name !== "string") return name;
  const hex = name.startsWith("#") ? name : colour(name);
  const digits = hex.length === 4 ? [...hex.slice(1)].map((one) => one + one) : hex.slice(1).match(/../g);
  return digits.map((two) => parseInt(two, 16) / 255);
}

// The colour of a share on a scale: shares in ascending order, each with its colour.
export function shade(scale, share) {
  const after = Math.max(1, scale.findIndex(([at]) => at >= share));
  const [[low, from], [high, to]] = [scale[after - 1], scale[after]];
  const part = Math.min(1, Math.max(0, (share - low) / (high - low)));
  const [a, b] = [rgb(from), rgb(to)];
  return a.map((one, i) => one + part * (b[i] - one));
}

const LOOKS = { home: [-0.72, -1.85, 0.85], top: [0, -0.002, 2.1], front: [0, -2.1, 0], side: [2.1, 0, 0] };
const TURN = Math.PI / 18;
const VIEW = (40 * Math.PI) / 180; // the angle of view
const GRAB_PX = 14;

const flat = (points) => (ArrayBuffer.isView(points) ? points : Float32Array.from(points.flatMap((one) => one ?? [NaN, NaN, NaN])));

// Where the last recorded position begins in a column; before and after a recording it is NaN.
export const lastOf = (points) => points.findLastIndex((one) => !Number.isNaN(one)) - 2;

// A line through points, [x, y, z] each, or all numbers in a Float32Array; null or NaN is a gap.
export function line(points, { name, width = 2, dash = "solid", ...more }) {
  return { kind: "line", points: flat(points), name, width, dash, ...more };
}

// Marks at points; `hover(i)` returns what is said of one beside its name, `picks[i]` what a click on it gives.
export function dots(points, { name, size = 4, symbol = "circle", ...more }) {
  return { kind: "dots", points: flat(points), name, size, symbol, ...more };
}

// Capsules: seven numbers each, both ends of the axis and the radius.
export function bodies(segments, more) {
  return { kind: "bodies", segments, ...more };
}

// The twelve edges of a grid world, at the outer faces of its cells; `place` moves a corner to the position of the box.
export function box(grid, place = (point) => point) {
  const low = grid.origin_mm.map((o) => o - grid.cell_mm / 2);
  const high = low.map((l, axis) => l + grid.shape[axis] * grid.cell_mm);
  const at = (i) => place([0, 1, 2].map((axis) => ((i >> axis) & 1 ? high[axis] : low[axis])));
  const edges = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
  return edges.flatMap(([a, b]) => [at(a), at(b), null]);
}

const minus = (a, b) => a.map((one, i) => one - b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((one) => one / Math.hypot(...a));

// The box around the points of lines and marks, and around the axes of capsules of which `bounds` is true.
function boundsOf(things) {
  const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  for (const { kind, points, segments, bounds = kind !== "bodies" } of things) {
    if (!bounds) continue;
    const [values, width] = kind === "bodies" ? [segments, 7] : [points, 3];
    for (let i = 0; i < values.length; i += 1) {
      if (i % width === 6) continue;
      const k = (i % width) % 3;
      if (values[i] < low[k]) low[k] = values[i];
      if (values[i] > high[k]) high[k] = values[i];
    }
  }
  return Number.isFinite(low[0]) ? [low, high] : [[-50, -50, -50], [50, 50, 50]];
}

export class Scene {
  // `traces` returns what to draw at every call; `picked` is called with what a click gives.
  constructor(traces, { picked } = {}) {
    this.place = document.getElementById("view");
    this.traces = traces;
    this.eye = LOOKS.home;
    this.shift = [0, 0, 0];
    this.drawn = this.begin(picked);
    this.drawn.catch((failed) => say(this.place, `The view cannot be drawn: ${failed.message}. The numbers below are valid.`));
  }

  async begin(picked) {
    [this.canvas, this.paper] = ["canvas", "canvas"].map((name) => document.createElement(name));
    this.hint = document.createElement("p");
    this.hint.className = "hint";
    this.hint.hidden = true;
    this.place.replaceChildren(this.canvas, this.paper, this.hint);
    this.ink = this.paper.getContext("2d");
    this.renderer = new Renderer(this.canvas, rgb);
    new ResizeObserver(() => this.paint()).observe(this.place);
    this.listen(picked);
    this.redraw();
    this.place.dataset.drawn = "true";
  }

  // Take new things to draw; the view stays, and holds what was drawn first and everything that is larger.
  redraw() {
    this.things = this.traces();
    this.renderer.buffers.forEach((_, thing) => this.things.includes(thing) || (thing.changed = true));
    const [low, high] = boundsOf(this.things);
    this.bounds = this.bounds ? [this.bounds[0].map((one, i) => Math.min(one, low[i])), this.bounds[1].map((one, i) => Math.max(one, high[i]))] : [low, high];
    this.paint();
    return this.drawn;
  }

  // Draw before the next frame, once however often it is asked for.
  paint() {
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = null;
      this.paintNow();
    });
  }

  paintNow() {
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const [wide, high] = [this.place.clientWidth, this.place.clientHeight];
    if (!wide || !high || !this.things) return;
    for (const one of [this.canvas, this.paper]) {
      if (one.width === Math.round(wide * ratio) && one.height === Math.round(high * ratio)) continue;
      one.width = Math.round(wide * ratio);
      one.height = Math.round(high * ratio);
    }
    this.draw(ratio);
    this.place.dataset.painted = Number(this.place.dataset.painted ?? 0) + 1;
  }

  draw(ratio) {
    const { canvas, ink, bounds: [low, high] } = this;
    const aspect = canvas.width / canvas.height;
    const reach = Math.max(10, Math.hypot(...minus(high, low)) / 2);
    const middle = low.map((one, i) => (one + high[i]) / 2 + this.shift[i]);
    const from = this.eye.map((one, i) => middle[i] + one * reach * 1.4 * Math.max(1, 1 / aspect));
    const z = unit(minus(from, middle));
    const x = unit(cross([0, 0, 1], z));
    const y = cross(z, x);
    const far = Math.hypot(...minus(from, middle));
    const [near, end] = [far / 100, far + 40 * reach];
    const f = 1 / Math.tan(VIEW / 2);
    const view = [x.map((one) => (one * f) / aspect), y.map((one) => one * f), z.map((one) => (-one * (end + near)) / (end - near)), z.map((one) => -one)];
    const last = view.map((row, i) => -dot(row, from) - (i === 2 ? (2 * end * near) / (end - near) : 0));
    this.matrix = [0, 1, 2, 3].flatMap((column) => view.map((row, i) => (column === 3 ? last[i] : row[column])));
    this.axes = { x, y, perPx: (2 * far * Math.tan(VIEW / 2)) / (canvas.height / ratio) };
    const edges = this.frame(low, high, from);
    for (const thing of [...this.things, ...edges.lines]) thing.mmPerPx = this.axes.perPx;
    this.renderer.draw([...this.things, ...edges.lines], new Float32Array(this.matrix), unit(z.map((one, i) => one + 0.5 * y[i] - 0.3 * x[i])), ratio);
    ink.setTransform(ratio, 0, 0, ratio, 0, 0);
    ink.clearRect(0, 0, this.paper.width, this.paper.height);
    this.write(edges.words, "11px system-ui, sans-serif", "soft");
    for (const { text, points, colour: name } of this.things.filter((thing) => thing.text)) {
      const words = text.map((one, i) => [one, points.subarray(3 * i, 3 * i + 3), 0, -12]);
      this.write(words, "600 13px system-ui, sans-serif", name);
    }
  }

  // Where a point is on the screen, in CSS pixels; null behind the camera.
  at([x, y, z]) {
    const m = this.matrix;
    const w = m[3] * x + m[7] * y + m[11] * z + m[15];
    if (!(w > 0)) return null;
    const across = (m[0] * x + m[4] * y + m[8] * z + m[12]) / w;
    const up = (m[1] * x + m[5] * y + m[9] * z + m[13]) / w;
    return [((1 + across) / 2) * this.place.clientWidth, ((1 - up) / 2) * this.place.clientHeight];
  }

  write(words, font, name) {
    this.ink.font = font;
    this.ink.fillStyle = colour(name);
    this.ink.textAlign = "center";
    this.ink.textBaseline = "middle";
    for (const [text, point, right, down] of words) {
      const at = this.at(point);
      if (at) this.ink.fillText(text, at[0] + right, at[1] + down);
    }
  }

  // The floor as a grid, an upright, and their numbers, at the edges that are nearer to the camera.
  frame(low, high, from) {
    const widest = Math.max(...minus(high, low));
    const step = [1, 2, 5, 10, 20, 50, 100, 200, 500].find((one) => widest / one <= 7) ?? 1000;
    const ticks = [0, 1, 2].map((axis) => {
      const found = [];
      for (let one = Math.ceil(low[axis] / step) * step; one <= high[axis] + 1e-9; one += step) found.push(one);
      return found;
    });
    const key = [low, high, step].join();
    if (this.floor?.key !== key) {
      const rows = ticks[0].flatMap((one) => [[one, low[1], low[2]], [one, high[1], low[2]], null]);
      const columns = ticks[1].flatMap((one) => [[low[0], one, low[2]], [high[0], one, low[2]], null]);
      this.floor = { key, lines: [line([...rows, ...columns], { colour: "line", width: 1, bounds: false }), null] };
    }
    const [front, beside] = [from[1] < (low[1] + high[1]) / 2 ? low[1] : high[1], from[0] < (low[0] + high[0]) / 2 ? low[0] : high[0]];
    const away = (axis, at) => (at === low[axis] ? -1 : 1) * 0.045 * widest;
    // The upright stands where the outline of the floor is furthest to the left.
    const posts = [[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]];
    const left = posts.reduce((best, post) => ((this.at([...post, low[2]])?.[0] ?? 1e9) < (this.at([...best, low[2]])?.[0] ?? 1e9) ? post : best));
    if (this.floor.post !== left.join()) this.floor.lines[1] = line([[...left, low[2]], [...left, high[2]]], { colour: "line", width: 1, bounds: false });
    this.floor.post = left.join();
    const tidy = (one) => String(Math.round(one * 100) / 100);
    const middle = (axis) => (low[axis] + high[axis]) / 2;
    const words = [];
    const upright = this.eye[2] / Math.hypot(...this.eye) < 0.99;
    if (Math.abs(this.eye[1]) > 0.25 * Math.hypot(...this.eye) || !upright) {
      words.push(...ticks[0].map((one) => [tidy(one), [one, front + away(1, front), low[2]], 0, 3]), ["x (mm)", [middle(0), front + 2.2 * away(1, front), low[2]], 0, 6]);
    }
    if (Math.abs(this.eye[0]) > 0.25 * Math.hypot(...this.eye) || !upright) {
      words.push(...ticks[1].map((one) => [tidy(one), [beside + away(0, beside), one, low[2]], 0, 3]), ["y (mm)", [beside + 2.2 * away(0, beside), middle(1), low[2]], 0, 6]);
    }
    if (upright) words.push(...ticks[2].slice(1).map((one) => [tidy(one), [...left, one], -20, 0]), ["z (mm)", [...left, high[2]], -8, -14]);
    return { lines: this.floor.lines, words };
  }

  look(eye) {
    this.eye = eye;
    this.place.dataset.eye = eye.map((one) => one.toFixed(3)).join(" ");
    this.paint();
  }

  turn(how) {
    const steps = { left: [-TURN, 0, 1], right: [TURN, 0, 1], up: [0, TURN, 1], down: [0, -TURN, 1], near: [0, 0, 1 / 1.2], away: [0, 0, 1.2] };
    this.swing(...steps[how]);
  }

  swing(around, above, closer) {
    const far = Math.hypot(...this.eye);
    const height = Math.max(-1.57, Math.min(1.57, Math.asin(this.eye[2] / far) + above));
    const angle = Math.atan2(this.eye[1], this.eye[0]) + around;
    const distance = Math.max(0.1, Math.min(8, far * closer));
    this.look([distance * Math.cos(height) * Math.cos(angle), distance * Math.cos(height) * Math.sin(angle), distance * Math.sin(height)]);
  }

  reset(eye) {
    this.shift = [0, 0, 0];
    this.bounds = boundsOf(this.things);
    this.look(eye);
  }

  listen(picked) {
    const keys = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", "+": "near", "=": "near", "-": "away" };
    this.place.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "0") this.reset(LOOKS.home);
      else if (keys[event.key]) this.turn(keys[event.key]);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
    this.place.closest(".scene").addEventListener("click", (event) => {
      const { look, turn, save } = event.target.closest("button")?.dataset ?? {};
      if (look) this.reset(LOOKS[look]);
      if (turn) this.turn(turn);
      if (save !== undefined) this.save();
    });
    this.place.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.swing(0, 0, Math.exp(Math.max(-100, Math.min(100, event.deltaY)) / 400));
    }, { passive: false });
    this.drag(picked);
    document.addEventListener("theme", () => this.redraw());
  }

  // One pointer turns, with shift or the right button it moves; two zoom. A press without a drag picks.
  drag(picked) {
    const held = new Map();
    let moved = 0;
    this.place.addEventListener("contextmenu", (event) => event.preventDefault());
    this.place.addEventListener("pointerdown", (event) => {
      held.set(event.pointerId, [event.clientX, event.clientY]);
      this.place.setPointerCapture(event.pointerId);
      moved = 0;
    });
    this.place.addEventListener("pointermove", (event) => {
      const before = held.get(event.pointerId);
      if (!before) return this.tell(event);
      const now = [event.clientX, event.clientY];
      const [right, down] = minus(now, before);
      moved += Math.abs(right) + Math.abs(down);
      const other = [...held].find(([id]) => id !== event.pointerId)?.[1];
      if (other) this.swing(0, 0, Math.hypot(...minus(before, other)) / Math.max(1, Math.hypot(...minus(now, other))));
      else if (event.shiftKey || event.buttons === 2) this.move(right, down);
      else this.swing(-right / 150, down / 150, 1);
      held.set(event.pointerId, now);
    });
    const end = (event) => {
      if (held.delete(event.pointerId) && picked && moved < 4 && event.type === "pointerup") {
        const found = this.nearest(event, (thing) => thing.picks);
        if (found) picked(found.thing.picks[found.i]);
      }
    };
    this.place.addEventListener("pointerup", end);
    this.place.addEventListener("pointercancel", end);
    this.place.addEventListener("pointerleave", () => (this.hint.hidden = true));
  }

  move(right, down) {
    const { x, y, perPx } = this.axes;
    this.shift = this.shift.map((one, i) => one - perPx * (right * x[i] - down * y[i]));
    this.paint();
  }

  // The nearest point on the screen of the things that fit.
  nearest(event, fits) {
    const frame = this.place.getBoundingClientRect();
    const [u, v] = [event.clientX - frame.left, event.clientY - frame.top];
    let best = null;
    for (const thing of this.things) {
      if (!thing.points || !fits(thing)) continue;
      for (let i = 0; i < thing.points.length / 3; i += 1) {
        const at = this.at(thing.points.subarray(3 * i, 3 * i + 3));
        const far = at ? Math.hypot(at[0] - u, at[1] - v) : Infinity;
        if (far < (best?.far ?? GRAB_PX)) best = { thing, i, far, at };
      }
    }
    return best;
  }

  tell(event) {
    const found = event.pointerType === "mouse" && this.nearest(event, (thing) => thing.name && thing.hover !== null);
    this.hint.hidden = !found;
    if (!found) return;
    const { thing, i, at } = found;
    const place = [...thing.points.subarray(3 * i, 3 * i + 3)].map((one) => one.toFixed(1)).join(", ");
    this.hint.textContent = [thing.name, `${place} mm`, thing.hover?.(i)].filter(Boolean).join("\n");
    this.hint.style.left = `${Math.min(at[0] + 12, this.place.clientWidth - this.hint.offsetWidth)}px`;
    this.hint.style.top = `${Math.max(0, at[1] - this.hint.offsetHeight - 6)}px`;
  }

  save() {
    this.paintNow();
    const whole = document.createElement("canvas");
    [whole.width, whole.height] = [this.canvas.width, this.canvas.height];
    const ink = whole.getContext("2d");
    ink.fillStyle = colour("card");
    ink.fillRect(0, 0, whole.width, whole.height);
    for (const one of [this.canvas, this.paper]) ink.drawImage(one, 0, 0);
    whole.toBlob((picture) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(picture);
      link.download = "view.png";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    });
  }
}

// A list of layers with their markers, to switch them on and off.
export function layerList(place, layers, changed) {
  for (const layer of layers) {
    const item = document.createElement("li");
    item.innerHTML = '<label class="tick"><input type="checkbox"><svg viewBox="0 0 26 16" aria-hidden="true"></svg><span></span></label>';
    const input = item.querySelector("input");
    input.checked = layer.on;
    input.id = `layer-${layer.id}`;
    input.addEventListener("change", () => {
      layer.on = input.checked;
      changed();
    });
    item.querySelector("span").textContent = layer.name;
    mark(item.querySelector("svg"), layer);
    place.append(item);
  }
}

function mark(svg, { shape, colour: name }) {
  const shapes = {
    line: '<path d="M1 12C8 2 18 14 25 4" fill="none" stroke-width="2.2"/>',
    squares: '<path d="M2 8h22" stroke-width="2.2"/><path d="M3 5h6v6h-6zM17 5h6v6h-6z"/>',
    dashes: '<path d="M1 8h24" stroke-width="2.6" stroke-dasharray="6 3"/>',
    circles: '<circle cx="6" cy="8" r="4" fill="none" stroke-width="1.6"/><circle cx="19" cy="8" r="6"/>',
    cells: '<path d="M2 6h4v4h-4zM11 6h4v4h-4zM20 6h4v4h-4z" fill-opacity=".6"/>',
    box: '<path d="M3 13v-9h15v9zM3 4l5-3h15v9l-5 3M18 4l5-3" fill="none" stroke-width="1.2"/>',
    ends: '<path d="M7 3l5 5-5 5-5-5z"/><path d="M19 3v10M14 8h10" stroke-width="2.4"/>',
    body: '<path d="M5 8h16" stroke-width="9" stroke-linecap="round"/>',
  };
  svg.innerHTML = shapes[shape];
  const paint = () => {
    svg.setAttribute("stroke", colour(name));
    svg.setAttribute("fill", colour(name));
  };
  paint();
  document.addEventListener("theme", paint);
}
