// The plan editor: suture points in a table and in a view from above, with one list behind both. Passes count from 0, as in reports.
import { call, root } from "./api.js";
import { drawing as element } from "./site.js";

const form = document.getElementById("plan");
const get = (id) => document.getElementById(id);
const goal = JSON.parse(form.dataset.goal);
const grid = JSON.parse(form.dataset.grid);
const before = JSON.parse(form.dataset.before);
const above = get("above");
const [MARGIN, STEP_MM, FAR_MM] = [14, 1, 5];
const AXES = ["x", "y", "z"];
const [MOST_PLACES, LEAST_STEP_MM] = [400, 2];
let path = [];
let points = [];
let places = [];
let step_mm = 0;

const degrees = ([x, y, z, w]) => (x || y ? null : (2 * Math.atan2(z, w) * 180) / Math.PI);
const turned = (angle) => [0, 0, Math.sin((angle * Math.PI) / 360), Math.cos((angle * Math.PI) / 360)];
// A rotation that is not about z alone comes from another plan, and is preserved until its number is changed.
const rotation = (point) => (point.angle === null ? point.rotation : turned(point.angle));

function lay(count, dx, dy) {
  const middle = (count - 1) / 2;
  points = Array.from({ length: count }, (_, i) => ({ at: [goal[0] + (i - middle) * dx, goal[1] + (i - middle) * dy, goal[2]], angle: 0 }));
  show();
}

function show() {
  get("points").replaceChildren(...points.map(rowOf));
  draw();
}

function field(value, label, changed) {
  const input = document.createElement("input");
  Object.assign(input, { type: "number", step: "any", value: value === null ? "" : Number(value.toFixed(3)), required: value !== null });
  if (value === null) input.placeholder = "unchanged";
  input.setAttribute("aria-label", label);
  input.addEventListener("input", () => {
    if (input.value === "" || !input.validity.valid) return;
    changed(Number(input.value));
    draw();
  });
  return input;
}

function rowOf(point, index) {
  const row = document.createElement("tr");
  const cells = AXES.map((axis, i) => field(point.at[i], `Pass ${index}, ${axis} in mm`, (value) => (point.at[i] = value)));
  cells.push(field(point.angle, `Pass ${index}, turn about z in degrees`, (value) => (point.angle = value)));
  const away = document.createElement("button");
  Object.assign(away, { type: "button", className: "quiet", textContent: "Remove", disabled: points.length === 1 });
  away.setAttribute("aria-label", `Remove pass ${index}`);
  away.addEventListener("click", () => {
    points.splice(index, 1);
    show();
  });
  const head = document.createElement("th");
  head.scope = "row";
  head.textContent = index;
  row.append(head, ...[...cells, away].map((one) => {
    const cell = document.createElement("td");
    cell.append(one);
    return cell;
  }));
  return row;
}

// Rotate and move a point of the demonstrated grid world to a pass.
function placed(point, place) {
  const [d, e, f] = point.map((value, i) => value - goal[i]);
  const [x, y, z, w] = rotation(place);
  const [a, b] = [
    (1 - 2 * (y * y + z * z)) * d + 2 * (x * y - z * w) * e + 2 * (x * z + y * w) * f,
    2 * (x * y + z * w) * d + (1 - 2 * (x * x + z * z)) * e + 2 * (y * z - x * w) * f,
  ];
  return [a + place.at[0], b + place.at[1]];
}

function floor() {
  const low = grid.origin_mm.map((one) => one - grid.cell_mm / 2);
  const high = low.map((one, i) => one + grid.cell_mm * grid.shape[i]);
  return [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]].map(([x, y]) => [x, y, goal[2]]);
}

let scale = 1;
let width = 560;
let held = null;
let window_mm = null; // fixed while a point is dragged, so that the view does not move under it

function draw() {
  const boxes = points.map((point) => floor().map((corner) => placed(corner, point)));
  if (held === null) window_mm = around([...boxes.flat(), ...points.map((point) => point.at)]);
  const { low, high } = window_mm;
  width = Math.max(240, above.parentElement.clientWidth);
  scale = (width - 2 * MARGIN) / (high[0] - low[0]);
  const height = (high[1] - low[1]) * scale + 2 * MARGIN;
  const at = ([x, y]) => [MARGIN + (x - low[0]) * scale, height - MARGIN - (y - low[1]) * scale];
  const line = (of) => of.map((point) => at(point).map((one) => one.toFixed(1)).join(",")).join(" ");
  above.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const focused = document.activeElement?.dataset?.index;
  above.replaceChildren(
    ...ticks(low, high, at, height),
    reachOf(at),
    ...boxes.map((corners) => element("polygon", { class: "box", points: line(corners) })),
    ...points.map((point) => element("polyline", { class: "path", points: line(path.map((one) => placed(one, point))) })),
    ...points.flatMap((point, index) => dotOf(point, index, at(point.at))),
  );
  if (focused !== undefined) above.querySelector(`[data-index="${focused}"]`)?.focus();
}

// The map of reach: a cell for each place, with its margins as a tooltip; one that can be planned adds a pass there.
function reachOf(at) {
  const all = element("g", { class: "reach" });
  const side = step_mm * scale;
  for (const place of places) {
    const [x, y] = at(place.position_mm);
    const kind = place.reach === "in doubt" ? "doubt" : place.reach;
    const cell = element("g", { class: kind });
    cell.append(element("rect", { x: x - side / 2, y: y - side / 2, width: side - 1, height: side - 1 }));
    const [l, r, t, b] = [x - side / 4, x + side / 4, y - side / 4, y + side / 4];
    if (kind !== "yes") cell.append(element("path", { d: `M${l} ${b} ${r} ${t}${kind === "no" ? `M${l} ${t} ${r} ${b}` : ""}` }));
    cell.append(element("title", {}, inWords(place)));
    if (kind !== "no") {
      for (const [name, value] of Object.entries({ tabindex: -1, role: "button", "aria-label": inWords(place) })) cell.setAttribute(name, value);
      cell.addEventListener("click", () => {
        points.push({ ...points.at(-1), at: [...place.position_mm] });
        show();
      });
    }
    all.append(cell);
  }
  return all;
}

function inWords(place) {
  const [x, y, z] = place.position_mm.map((one) => one.toFixed(1));
  const told = [["joints", place.turn_margin_deg, "°"], ["insertion", place.insertion_margin_mm, " mm"], ["arms", place.bodies_mm, " mm"], ["tools", place.tools_mm, " mm"], ["scene", place.scene_mm, " mm"], ["needle", place.needle_mm, " mm"]];
  const margins = told.filter(([, value]) => value !== null).map(([name, value, unit]) => `${name} ${value.toFixed(1)}${unit}`);
  const answer = { yes: "can be planned", no: "refused", "in doubt": "in doubt" }[place.reach];
  return `${x}, ${y}, ${z} mm: ${answer}${place.limited_by ? `, ${place.limited_by}` : ""} (${margins.join(", ")})`;
}

function around(of) {
  const [xs, ys] = [of.map((one) => one[0]), of.map((one) => one[1])];
  return { low: [Math.min(...xs) - 5, Math.min(...ys) - 5], high: [Math.max(...xs) + 5, Math.max(...ys) + 5] };
}

function ticks(low, high, at, height) {
  const step = high[0] - low[0] > 300 ? 50 : 20;
  const drawn = [];
  for (let x = Math.ceil(low[0] / step) * step; x <= high[0]; x += step) {
    drawn.push(element("line", { class: "tick", x1: at([x, 0])[0], x2: at([x, 0])[0], y1: 0, y2: height }), element("text", { x: at([x, 0])[0] + 3, y: height - 4 }, x));
  }
  for (let y = Math.ceil(low[1] / step) * step; y <= high[1]; y += step) {
    drawn.push(element("line", { class: "tick", x1: 0, x2: width, y1: at([0, y])[1], y2: at([0, y])[1] }), element("text", { x: 3, y: at([0, y])[1] - 3 }, y));
  }
  return drawn;
}

function dotOf(point, index, [x, y]) {
  const dot = element("circle", { class: "dot", cx: x, cy: y, r: 9, tabindex: 0, role: "slider", "data-index": index, "aria-label": `Suture point ${index}`, "aria-valuetext": `x ${point.at[0].toFixed(1)}, y ${point.at[1].toFixed(1)} mm`, "aria-valuenow": index });
  dot.addEventListener("pointerdown", (event) => drag(event, point));
  dot.addEventListener("keydown", (event) => {
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!move) return;
    event.preventDefault();
    const step = event.shiftKey ? FAR_MM : STEP_MM;
    point.at = [point.at[0] + move[0] * step, point.at[1] + move[1] * step, point.at[2]];
    show();
  });
  return [dot, element("text", { class: "mark", x, y: y + 4 }, index)];
}

function drag(event, point) {
  event.preventDefault();
  held = { x: event.clientX, y: event.clientY, at: [...point.at] };
  const move = ({ clientX, clientY }) => {
    const there = [held.at[0] + (clientX - held.x) / scale, held.at[1] - (clientY - held.y) / scale];
    point.at = [...there.map((one) => Math.round(one * 10) / 10), point.at[2]];
    show();
  };
  const stop = () => {
    removeEventListener("pointermove", move);
    held = null;
    draw();
  };
  addEventListener("pointermove", move);
  addEventListener("pointerup", stop, { once: true });
}

get("add").addEventListener("click", () => {
  const last = points.at(-1);
  points.push({ ...last, at: [last.at[0] + Number(get("line-x").value), last.at[1] + Number(get("line-y").value), last.at[2]] });
  show();
});
get("lay").addEventListener("click", () => {
  if (get("line-count").reportValidity()) lay(Number(get("line-count").value) || 1, Number(get("line-x").value), Number(get("line-y").value));
});
addEventListener("resize", draw);
get("style").addEventListener("change", ({ target }) => {
  const [surgeon, suture, version] = target.value.split("/");
  location.assign(`${root}/pages/plans/new?${new URLSearchParams({ surgeon, suture, version })}`);
});

const numbers = (text) => text.split(/[\s,;]+/).filter(Boolean).map(Number);

function psmM() {
  const { approach, base_mm: base, base_xyzw: turn, psm_m_instrument: instrument, enters, source } = form.elements;
  const asked = {
    ...(approach.value && { approach: numbers(approach.value) }),
    ...((base.value || turn.value) && { base: { position_mm: numbers(base.value), rotation_xyzw: numbers(turn.value || "0 0 0 1") } }),
    ...(instrument.value && { instrument: instrument.value }),
  };
  if (!Object.keys(asked).length && enters.value === "after_A1") return null;
  return { ...asked, enters: enters.value, ...(source.value && { source: source.value }) };
}

// The settings that a plan and a map of reach share.
function asked() {
  const { tip_offset_mm: offset, handoff, orientation, a2, tissue_mm: tissue } = form.elements;
  return {
    surgeon: form.dataset.surgeon, suture: form.dataset.suture, version: Number(form.dataset.version),
    tip_offset_mm: Number(offset.value), orientation: orientation.value || null, a2: a2.value || null,
    ...(tissue.value && { tissue_mm: Number(tissue.value) }), ...(handoff.value === "none" ? { handoff: "none" } : { psm_m: psmM() }),
  };
}

get("reach").addEventListener("click", async ({ target }) => {
  const { low, high } = window_mm;
  const size = high.map((one, i) => Math.min(400, one - low[i]));
  const step = Math.max(LEAST_STEP_MM, Math.sqrt((size[0] * size[1]) / MOST_PLACES));
  const last = points.at(-1);
  target.disabled = true;
  try {
    const found = await call("POST", "/reach", {
      ...asked(), centre_mm: [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, last.at[2]], size_mm: [...size, 0],
      step_mm: Math.ceil(step * 10) / 10, rotations_xyzw: [rotation(last)],
    });
    [places, step_mm] = [found.places, found.step_mm];
    get("reach-key").hidden = false;
    get("reach-said").textContent = found.description;
    get("reach-said").className = "small";
    draw();
  } catch (problem) {
    get("reach-said").textContent = problem.message;
    get("reach-said").className = "said wrong";
  }
  target.disabled = false;
});

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const { arm, frame, instrument, speed_mm_s: speed } = form.elements;
  const button = form.querySelector("button:not([type])");
  const said = get("plan-said");
  said.className = "said";
  said.textContent = "";
  button.disabled = true;
  try {
    const plan = await call("POST", "/plans", {
      ...asked(), suture_points: points.map((point) => ({ position_mm: point.at, rotation_xyzw: rotation(point) })),
      arm: arm.value || null, frame: frame.value || null, instrument: instrument.value || null,
      speed_mm_s: Number(speed.value),
    });
    location.assign(`${root}/pages/plans/${plan.id}`);
  } catch (problem) {
    said.textContent = problem.message;
    said.className = "said wrong";
    button.disabled = false;
  }
});

if (before) {
  points = before.map((pass) => ({ at: [...pass.position_mm], angle: degrees(pass.rotation_xyzw), rotation: pass.rotation_xyzw }));
  show();
} else lay(5, 6, 0);
try {
  path = (await call("GET", form.dataset.view)).path_mm;
  draw();
  above.dataset.drawn = "true";
} catch (problem) {
  get("plan-said").textContent = problem.message;
  get("plan-said").className = "said wrong";
}
