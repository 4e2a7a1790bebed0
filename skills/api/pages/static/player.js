// The player: one clock for the 3-D view and the plots of one or two motions.
import { call } from "./api.js";
import { Plot } from "./plot.js";
import { Scene, bodies, dots, lastOf, layerList, line } from "./scene.js";
import { element, percent, say } from "./site.js";

const get = (id) => document.getElementById(id);
const player = get("player");
const names = JSON.parse(player.dataset.names);
const marks = JSON.parse(player.dataset.marks); // parts to show, in seconds on the clock of the first motion
const JOINTS = ["yaw", "pitch", "insertion", "roll", "wrist pitch", "wrist yaw"];
// A colour for each arm, of the first motion and of the second; the second is also drawn dashed.
const COLOURS = [["path", "learnt"], ["goal", "other"]];
const OF_ERRORS = ["goal", "reward", "wrong"]; // a third each of the greatest;
const OF_TRACES = ["path", "learnt", "goal", "other"];
const TOOL_MM = { radius: 2.2, finger: 1.1, behind: 12 };
const SEEN_MM = 0.3; // of a path on the screen

const layers = [
  { id: "trails", name: "Paths of the tips", shape: "line", colour: "path", on: true },
  { id: "tools", name: "Tips and jaws", shape: "body", colour: "path", on: true },
  { id: "tube", name: "Predicted error of the tip, executed (colour: its size)", shape: "body", colour: "other", on: true },
  { id: "bodies", name: "Outer bodies of the arms", shape: "body", colour: "box", on: false },
  { id: "marks", name: "Start and end", shape: "ends", colour: "goal", on: false },
];
const on = (id) => layers.find((layer) => layer.id === id)?.on;

// ---- the columns

function column(text) {
  if (Uint8Array.fromBase64) return new Float32Array(Uint8Array.fromBase64(text).buffer);
  const said = atob(text);
  const bytes = new Uint8Array(said.length);
  for (let i = 0; i < said.length; i += 1) bytes[i] = said.charCodeAt(i);
  return new Float32Array(bytes.buffer);
}

function read({ timeline }) {
  const opened = { ...timeline, way: column(timeline.way), shift: [0, 0, 0] };
  opened.traces = timeline.traces.map((one) => ({ ...one, values: column(one.values) }));
  opened.arms = timeline.arms.map((arm) => {
    const found = { ...arm };
    for (const name of ["tip_mm", "rotation_xyzw", "jaw_rad", "joints", "speed_mm_s", "bodies_mm", "off_mm"]) found[name] = arm[name] && column(arm[name]);
    return found;
  });
  opened.duration = (opened.rows - 1) / opened.rate_hz;
  return opened;
}

// A number of a column between two rows; `width` numbers a row.
function between(values, width, k, row) {
  const low = Math.min(Math.floor(row), values.length / width - 1);
  const high = Math.min(low + 1, values.length / width - 1);
  return values[low * width + k] + (row - low) * (values[high * width + k] - values[low * width + k]);
}

// The direction of an axis of the jaws.
function axis(rotation, row, which) {
  let [x, y, z, w] = [0, 1, 2, 3].map((k) => rotation[4 * Math.round(row) + k]);
  if (which === 2) return [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)];
  return [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)];
}

const along = (point, direction, far) => point.map((one, i) => one + far * direction[i]);
const minus = (a, b) => a.map((one, i) => one - b[i]);

// ---- the view

// The tool of an arm: its wrist, or a piece as long where that is not known, and two fingers; a ball without orientation.
function tool(motion, arm, row, wrist) {
  const at = [0, 1, 2].map((k) => between(arm.tip_mm, 3, k, row) + motion.shift[k]);
  if (at.some(Number.isNaN)) return [];
  if (!arm.rotation_xyzw) return [[at, at, 2 * TOOL_MM.radius]];
  const [approach, across] = [axis(arm.rotation_xyzw, row, 2), axis(arm.rotation_xyzw, row, 1)];
  const opening = Math.max(0, arm.jaw_rad ? between(arm.jaw_rad, 1, 0, row) : 0.1) / 2;
  const shapes = [[wrist ?? along(at, approach, -TOOL_MM.behind), at, TOOL_MM.radius]];
  for (const side of [1, -1]) {
    const finger = approach.map((one, i) => Math.cos(opening) * one + side * Math.sin(opening) * across[i]);
    shapes.push([along(at, across, 0.6 * side), along(along(at, across, 0.6 * side), finger, motion.finger_mm), TOOL_MM.finger]);
  }
  return shapes;
}

function outer(motion, arm, row) {
  const count = arm.bodies.length;
  const here = row / motion.every;
  return arm.bodies.map((name, i) => {
    const ends = [0, 1, 2, 3, 4, 5].map((k) => between(arm.bodies_mm, 6 * count, 6 * i + k, here) + motion.shift[k % 3]);
    return [ends.slice(0, 3), ends.slice(3), name === "shaft" ? TOOL_MM.radius : arm.radii_mm[i], name === "shaft"];
  }).filter(([from, to]) => ![...from, ...to].some(Number.isNaN));
}

const flat = (shapes) => Float32Array.from(shapes.flatMap(([from, to, radius]) => [...from, ...to, radius]));

// The points of a path that a screen can tell apart, and their rows.
function drawable(tips, shift) {
  const points = new Float32Array(tips.length);
  const rows = [];
  let [x, y, z, count] = [NaN, NaN, NaN, 0];
  for (let i = 0; i < tips.length; i += 3) {
    const [dx, dy, dz] = [tips[i] - x, tips[i + 1] - y, tips[i + 2] - z];
    if (dx * dx + dy * dy + dz * dz < SEEN_MM * SEEN_MM && i + 3 < tips.length) continue;
    [x, y, z] = [tips[i], tips[i + 1], tips[i + 2]];
    for (let k = 0; k < 3; k += 1) points[3 * count + k] = tips[i + k] + shift[k];
    rows.push(i / 3);
    count += 1;
  }
  return [points.subarray(0, 3 * count), rows];
}

// The tube in which an executed tip is predicted, a colour for each third of its greatest radius.
function tube(arm, trail, rows) {
  const most = arm.off_mm.reduce((a, b) => (b > a ? b : a), 0);
  const thirds = [[], [], []];
  rows.slice(1).forEach((row, i) => {
    const ends = [...trail.slice(3 * i, 3 * i + 6)];
    if (!ends.some(Number.isNaN)) thirds[Math.min(2, Math.floor((3 * arm.off_mm[row]) / most))].push([ends.slice(0, 3), ends.slice(3), arm.off_mm[row]]);
  });
  return thirds.map((mine, i) => bodies(flat(mine), { colour: OF_ERRORS[i], opacity: 0.3 })).filter((_, i) => thirds[i].length);
}

// The things that stand still, and those that move, of every arm.
function stage(motions) {
  const [still, moving] = [[], []];
  motions.forEach((motion, m) => motion.arms.forEach((arm, a) => {
    const name = [names[m], arm.arm].join(", ");
    const colour = COLOURS[m][a % 2];
    const [trail, rows] = drawable(arm.tip_mm, motion.shift);
    const look = { colour, dash: m ? "dash" : "solid" };
    still.push({ layer: "trails", thing: line(trail, { ...look, width: 1.5, opacity: 0.35 }) });
    const seen = line(trail, { ...look, width: 2.5, name, hover: null, shown: 0, bounds: false });
    const first = trail.findIndex((one) => !Number.isNaN(one));
    const last = lastOf(trail);
    if (first >= 0) {
      still.push({ layer: "marks", thing: dots(trail.slice(first, first + 3), { colour: "start", symbol: "diamond", size: 6, name: `start of ${name}` }) });
      still.push({ layer: "marks", thing: dots(trail.slice(last, last + 3), { colour: "goal", symbol: "cross", size: 6, name: `end of ${name}` }) });
    }
    if (arm.off_mm) for (const thing of tube(arm, trail, rows)) still.push({ layer: "tube", thing });
    const jaws = bodies(new Float32Array(7), { colour, bounds: true });
    const shaft = bodies(new Float32Array(7), { colour: "box" });
    const arms = bodies(new Float32Array(7), { colour: "box", opacity: 0.35, bounds: true });
    moving.push({ motion, arm, rows, seen, jaws, shaft, arms });
  }));
  return { still, moving };
}

function things({ still, moving }) {
  const shown = still.filter(({ layer }) => on(layer)).map(({ thing }) => thing);
  for (const { arm, seen, jaws, shaft, arms } of moving) {
    if (on("trails")) shown.push(seen);
    if (on("tools")) shown.push(jaws, ...(arm.bodies_mm ? [shaft] : []));
    if (on("bodies") && arm.bodies_mm) shown.push(arms);
  }
  return shown;
}

function move({ moving }, rows) {
  for (const { motion, arm, rows: kept, seen, jaws, shaft, arms } of moving) {
    const row = rows.get(motion);
    seen.shown = kept.findIndex((one) => one >= row);
    const outside = arm.bodies_mm ? outer(motion, arm, row) : [];
    if (on("tools")) replace(jaws, tool(motion, arm, row, outside.find((one) => one[3])?.[1]));
    if (!arm.bodies_mm) continue;
    replace(shaft, outside.filter((one) => one[3]));
    replace(arms, outside.filter((one) => !one[3]));
  }
}

function replace(thing, shapes) {
  thing.segments = flat(shapes);
  thing.changed = true;
}

// ---- the clock

let motions = [], scene, staged, plots = [], now = 0, playing = false, before = 0;
const byWay = () => get("step")?.value === "way";
const end = () => (byWay() ? motions[0].duration : Math.max(...motions.map((one) => one.duration)));
const ends = (motion) => (byWay() ? motions[0].duration : motion.duration);

// The row of a motion at a time of the clock, which is that of the first motion in seconds from its start.
function rowOf(motion, at) {
  if (motion === motions[0] || !byWay()) return Math.min(motion.rows - 1, at * motion.rate_hz);
  return rowAt(motion, between(motions[0].way, 1, 0, Math.min(motions[0].rows - 1, at * motions[0].rate_hz)));
}

// The first row at which a share of the way is done.
function rowAt({ way, rows }, share) {
  let [low, high] = [0, rows - 1];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (way[middle] < share) low = middle + 1;
    else high = middle;
  }
  return low;
}

function show(seconds) {
  now = Math.max(0, Math.min(end(), seconds));
  const rows = new Map(motions.map((motion) => [motion, rowOf(motion, now)]));
  move(staged, rows);
  scene.paint();
  get("at").value = now;
  get("time").textContent = `${(now + motions[0].start_s).toFixed(2)} s of ${(end() + motions[0].start_s).toFixed(2)} s`;
  get("at").setAttribute("aria-valuetext", `${(now + motions[0].start_s).toFixed(2)} seconds`);
  plots.forEach((plot) => plot.mark(rows, now));
  tell(rows);
}

let told = "";
function tell(rows) {
  const lines = motions.flatMap((motion, m) => {
    const row = Math.round(rows.get(motion));
    const at = motion.start_s + row / motion.rate_hz;
    const stage = motion.stages.filter((one) => one.start_s <= at && at <= one.end_s).map((one) => one.name).join(", ");
    const clutch = motion.clutch_s.some(([from, to]) => from <= at && at <= to);
    const lines = [];
    if (motion.stages.length) lines.push([m ? "Stage of the second" : "Stage", stage || "–"]);
    if (motion.clutch_s.length) lines.push(["Clutch", clutch ? "down" : "up"]);
    for (const arm of motion.arms) lines.push([`${arm.arm}${m ? ", second" : ""}`, `${number(arm.speed_mm_s[row], "mm/s")}${arm.jaw_rad ? `, jaw ${number((arm.jaw_rad[row] * 180) / Math.PI, "°")}` : ""}`]);
    for (const trace of motion.traces) lines.push([trace.name, trace.unit ? number(trace.values[row], trace.unit) : Number.isNaN(trace.values[row]) ? "–" : percent(trace.values[row], 1)]);
    return lines;
  });
  const text = JSON.stringify(lines);
  if (text === told) return;
  told = text;
  const place = get("now");
  while (place.rows.length < lines.length) place.append(element("tr", {}, element("th", { scope: "row" }), element("td", { className: "number" })));
  lines.forEach(([name, value], i) => {
    const [head, cell] = place.rows[i].cells;
    if (head.textContent !== name) head.textContent = name;
    if (cell.textContent !== value) cell.textContent = value;
  });
}

const number = (value, unit) => (Number.isNaN(value) ? "–" : `${value.toFixed(1)}\u00a0${unit}`);

function tick(at) {
  if (!playing) return;
  const step = ((at - before) / 1000) * Number(get("speed").value);
  before = at;
  if (now + step >= end() && !get("loop").checked) {
    show(end());
    return play(false);
  }
  show(now + step >= end() ? 0 : now + step);
  requestAnimationFrame(tick);
}

function play(wanted) {
  if (wanted === playing) return;
  playing = wanted;
  get("play").textContent = playing ? "⏸ Pause" : "▶ Play";
  if (!playing) return;
  if (now >= end()) now = 0;
  before = performance.now();
  requestAnimationFrame(tick);
}

// ---- the plots

function lines(of, width, k, name, m, a) {
  return { motion: motions[m], name, values: of, width, k, colour: COLOURS[m][a % 2], dashed: m > 0 };
}

function draws() {
  const speeds = [], jaws = [], joints = [[], []], distances = [], odds = [], errors = [], efforts = [];
  motions.forEach((motion, m) => {
    motion.arms.forEach((arm, a) => {
      const name = motions.length > 1 ? `${arm.arm}${m ? " of the second" : ""}` : arm.arm;
      speeds.push(lines(arm.speed_mm_s, 1, 0, name, m, a));
      if (arm.jaw_rad) jaws.push({ ...lines(arm.jaw_rad, 1, 0, name, m, a), scale: 180 / Math.PI });
      if (arm.off_mm) errors.push(lines(arm.off_mm, 1, 0, name, m, a));
      if (arm.joints) JOINTS.forEach((joint, k) => (k === 2 ? joints[1] : joints[0]).push({ ...lines(arm.joints, 6, k, `${name} ${joint}`, m, a), scale: k === 2 ? 1 : 180 / Math.PI, thin: k > 0, key: k === 2 ? null : name }));
    });
    motion.traces.forEach((trace, i) => (trace.unit === "mm" ? distances : trace.unit ? efforts : odds).push({ ...lines(trace.values, 1, 0, `${trace.name}${m ? ", second" : ""}`, m, i), colour: OF_TRACES[i % OF_TRACES.length], limit: trace.limit, scale: trace.unit ? 1 : 100 }));
  });
  return [
    ["Speed of the tips, mm/s", speeds, { zero: true, stages: true }], ["Jaws, °", jaws], ["Distances, mm; dotted: the least that is permitted", distances],
    ["Share of worlds in which the pass goes well, %", odds, { range: [0, 100] }], ["Greatest predicted error of the tip as executed, mm", errors, { zero: true }], ["Efforts as executed, % of their limits", efforts, { range: [0, 100] }], ["Joints that turn, °", joints[0]], ["Insertion, mm", joints[1]],
  ].filter(([, mine]) => mine.length);
}

function plotAll() {
  const place = get("charts");
  plots = draws().map(([title, mine, more]) => new Plot(place, title, mine, { ...more, motions, marks, end, ends, rowOf, scrub: show }));
}

// ---- the controls

function restage() {
  if (motions[1]) {
    const [a, b] = motions.map(({ arms: [{ tip_mm: tips }] }) => tips.slice(lastOf(tips), lastOf(tips) + 3));
    motions[1].shift = get("place").value === "end" ? Array.from(a, (one, k) => one - b[k]) : [0, 0, 0];
  }
  staged = stage(motions);
}

function listen() {
  get("play").addEventListener("click", () => play(!playing));
  get("at").addEventListener("input", () => show(Number(get("at").value)));
  document.querySelectorAll("[data-mark]").forEach((one) => one.addEventListener("click", () => show(marks[one.dataset.mark][0] - motions[0].start_s)));
  get("step")?.addEventListener("change", () => {
    get("at").max = end();
    plots.forEach((plot) => plot.draw());
    show(now);
  });
  get("place")?.addEventListener("change", () => {
    restage();
    scene.bounds = null;
    show(now);
    scene.redraw();
  });
  document.addEventListener("theme", () => {
    restage();
    show(now);
    scene.redraw();
    plots.forEach((plot) => plot.draw());
    show(now);
  });
  addEventListener("resize", () => {
    plots.forEach((plot) => plot.draw());
    show(now);
  });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, input:not([type=range]), textarea, dialog, #view")) return;
    const far = event.shiftKey ? 1 : 0.1;
    const speed = get("speed");
    const keys = {
      " ": () => play(!playing), ArrowLeft: () => show(now - far), ArrowRight: () => show(now + far), Home: () => show(0), End: () => show(end()),
      ",": () => (speed.selectedIndex = Math.max(0, speed.selectedIndex - 1)), ".": () => (speed.selectedIndex = Math.min(speed.length - 1, speed.selectedIndex + 1)),
      l: () => (get("loop").checked = !get("loop").checked),
    };
    if (event.key === " " && event.target.closest("button, a")) return;
    const act = keys[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });
}

try {
  const asked = Promise.all([player.dataset.shown, player.dataset.beside].filter(Boolean).map((path) => call("GET", path)));
  scene = new Scene(() => (staged ? things(staged) : [])); // its programs are compiled while the motions are read
  motions = (await asked).map(read);
  if (!motions.some((motion) => motion.arms.some((arm) => arm.bodies_mm))) layers.splice(layers.findIndex((one) => one.id === "bodies"), 1);
  if (!motions.some((motion) => motion.arms.some((arm) => arm.off_mm))) layers.splice(layers.findIndex((one) => one.id === "tube"), 1);
  restage();
  let wide = on("bodies");
  layerList(get("layers"), layers, () => {
    show(now);
    if (wide !== on("bodies")) scene.bounds = null; // the arms are ten times as large as their motion
    wide = on("bodies");
    scene.redraw();
  });
  await scene.drawn;
  const frames = [...new Set(motions.flatMap((motion) => motion.arms.map((arm) => arm.frame)))].join(", ");
  const apart = motions.some((motion) => !motion.in_one_frame) ? " The arms' bases are not known: each arm is in a frame of its own." : "";
  get("frames").prepend(`In the frame ${frames}.${apart} `);
  scene.bounds = null;
  get("at").max = end();
  for (const id of ["at", "play"]) get(id).disabled = false;
  get("loading").remove();
  show(0);
  scene.redraw();
  await new Promise((wake) => requestAnimationFrame(wake)); // the picture comes before the plots
  performance.mark("first picture");
  plotAll();
  show(marks.length ? marks[0][0] - motions[0].start_s : 0);
  listen();
  player.dataset.ready = "true";
} catch (problem) {
  get("loading").remove();
  say(get("view"), problem.message);
}
