// A recording's timeline, and the form that cuts a hand-off out of it and trains it.
import { call, root, watch } from "./api.js";
import { confirmed, drawing as element, jobLine, rowOf } from "./site.js";

const get = (id) => document.getElementById(id);
const cut = get("cut");
const duration = Number(cut.dataset.duration);
const segments = JSON.parse(cut.dataset.segments);
const taken = JSON.parse(cut.dataset.taken);
const form = get("accept");
const { start_s: first, end_s: last, arm: armField } = form.elements;
const svg = document.querySelector("#timeline svg");
const HEIGHT = 170;
const PLOT = { left: 40, right: 40, top: 18, bottom: 24 };
let traces = { arms: [] };

function tell(id, text, kind = "wrong") {
  get(id).className = `said ${text ? kind : ""}`;
  get(id).textContent = text;
}

// The two number fields hold the cut; sliders, handles and proposals write to them.
function set(start, end) {
  const [a, b] = [Math.max(0, Math.min(start, duration)), Math.max(0, Math.min(end, duration))];
  first.value = Number(a.toFixed(6));
  last.value = Number(b.toFixed(6));
  shown();
}

function shown() {
  get("from").value = first.value;
  get("to").value = last.value;
  const wrong = Number(first.value) >= Number(last.value);
  last.setCustomValidity(wrong ? "The end must be after the beginning." : "");
  draw();
}

function choose(index) {
  const segment = segments[index];
  if (!segment) return;
  armField.value = segment.arm;
  get("reason").textContent = `Proposed because ${segment.reason}.`;
  const radio = document.querySelector(`input[name="proposal"][value="${index}"]`);
  if (radio) radio.checked = true;
  set(segment.start_s, segment.end_s);
}

let at = (seconds) => seconds;
let secondsAt = (x) => x;

function draw() {
  const width = Math.max(280, svg.parentElement.clientWidth);
  const [inner, height] = [width - PLOT.left - PLOT.right, HEIGHT - PLOT.top - PLOT.bottom];
  at = (seconds) => PLOT.left + (seconds / duration) * inner;
  secondsAt = (x) => ((x - PLOT.left) / inner) * duration;
  svg.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
  const focused = document.activeElement?.dataset?.index;
  svg.replaceChildren(...axis(width, height), ...signals(height), ...bands(height), ...selection(height));
  if (focused !== undefined) svg.querySelector(`[data-index="${focused}"]`)?.focus();
}

function axis(width, height) {
  const step = [0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600].find((one) => duration / one <= width / 70) ?? 7200;
  const ticks = [];
  for (let t = 0; t <= duration; t += step) {
    ticks.push(element("line", { class: "tick", x1: at(t), x2: at(t), y1: PLOT.top, y2: PLOT.top + height }));
    ticks.push(element("text", { x: at(t), y: HEIGHT - 8, "text-anchor": "middle" }, `${t} s`));
  }
  return ticks;
}

function signals(height) {
  const arm = traces.arms.find((one) => one.arm === armField.value) ?? traces.arms[0];
  if (!arm) return [];
  const curve = (name, t, values, low, high) => {
    const y = (value) => PLOT.top + height * (1 - (value - low) / (high - low || 1));
    return element("polyline", { class: name, points: t.map((s, i) => `${at(s).toFixed(1)},${y(values[i]).toFixed(1)}`).join(" ") });
  };
  const most = Math.max(1, ...arm.speed.mm_s);
  const drawn = arm.clutch_s.map(([a, b]) => element("rect", { class: "clutch", x: at(a), width: Math.max(1, at(b) - at(a)), y: PLOT.top, height }));
  drawn.push(curve("speed", arm.speed.t_s, arm.speed.mm_s, 0, most), element("text", { x: 4, y: PLOT.top + 8 }, most.toFixed(0)), element("text", { x: 4, y: PLOT.top + 21 }, "mm/s"));
  if (arm.jaw) {
    const [low, high] = [Math.min(...arm.jaw.rad), Math.max(...arm.jaw.rad)];
    const right = at(duration) + 5;
    drawn.push(curve("jaw", arm.jaw.t_s, arm.jaw.rad, low, high), element("text", { x: right, y: PLOT.top + 8 }, high.toFixed(2)), element("text", { x: right, y: PLOT.top + 21 }, "rad"));
  }
  return drawn;
}

function bands(height) {
  const mine = taken.map(([a, b]) => element("rect", { class: "taken", x: at(a), width: at(b) - at(a), y: PLOT.top + height - 8, height: 8 }));
  return mine.concat(
    segments.map((segment, index) => {
      const label = `Proposal ${index + 1}, ${segment.arm}, ${segment.start_s.toFixed(2)} to ${segment.end_s.toFixed(2)} seconds`;
      const band = element("g", { tabindex: 0, role: "button", "aria-label": label, "data-index": index });
      band.append(
        element("rect", { class: "proposal", x: at(segment.start_s), width: at(segment.end_s) - at(segment.start_s), y: PLOT.top, height }),
        element("text", { x: (at(segment.start_s) + at(segment.end_s)) / 2, y: PLOT.top - 5, "text-anchor": "middle" }, index + 1),
      );
      band.addEventListener("click", () => choose(index));
      band.addEventListener("keydown", (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        choose(index);
      });
      return band;
    }),
  );
}

function selection(height) {
  const [a, b] = [Number(first.value), Number(last.value)];
  if (!(b > a)) return [];
  const drawn = [element("rect", { class: "cut", x: at(a), width: at(b) - at(a), y: PLOT.top, height })];
  for (const [field, seconds] of [[first, a], [last, b]]) {
    const handle = element("rect", { class: "handle", x: at(seconds) - 5, width: 10, y: PLOT.top + height / 2 - 16, height: 32, rx: 4 });
    handle.addEventListener("pointerdown", (event) => drag(event, field));
    drawn.push(handle);
  }
  return drawn;
}

function drag(event, field) {
  event.preventDefault();
  const move = ({ clientX }) => {
    const box = svg.getBoundingClientRect();
    const seconds = secondsAt((clientX - box.left) * (svg.viewBox.baseVal.width / box.width));
    field === first ? set(seconds, Number(last.value)) : set(Number(first.value), seconds);
  };
  const stop = () => removeEventListener("pointermove", move);
  addEventListener("pointermove", move);
  addEventListener("pointerup", stop, { once: true });
}

for (const field of [first, last]) field.addEventListener("input", shown);
get("from").addEventListener("input", () => set(Number(get("from").value), Number(last.value)));
get("to").addEventListener("input", () => set(Number(first.value), Number(get("to").value)));
armField.addEventListener("change", draw);
get("proposals").addEventListener("change", (event) => choose(Number(event.target.value)));
addEventListener("resize", draw);

if (segments.length) choose(0);
else set(0, duration);
try {
  traces = await call("GET", `/pages/recordings/${cut.dataset.recording}/traces`);
  draw();
  svg.dataset.drawn = "true";
} catch (problem) {
  tell("timeline-said", `The signals cannot be drawn: ${problem.message}`);
}

let demo;
form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const button = form.querySelector("button");
  const { surgeon, suture, arm, grid, cell_mm: cell, outcome, outcome_reason: why } = form.elements;
  tell("accept-said", "");
  button.disabled = true;
  try {
    demo = await call("POST", `/recordings/${cut.dataset.recording}/demos`, {
      surgeon: surgeon.value, suture: suture.value, arm: arm.value, grid: grid.value,
      start_s: Number(first.value), end_s: Number(last.value), ...(cell.value && { cell_mm: Number(cell.value) }),
      ...(outcome.value && { outcome: outcome.value }), ...(why.value && { outcome_reason: why.value }),
    });
    taken.push([demo.start_s, demo.end_s]);
    draw();
    made();
  } catch (problem) {
    tell("accept-said", problem.message);
  } finally {
    button.disabled = false;
  }
});

const number = (value, unit, digits = 2) => `${Number(value.toFixed(digits))} ${unit}`;
const triple = (values) => `${values.map((one) => one.toFixed(2)).join(", ")} mm`;

function made() {
  const report = demo.report;
  const rows = [
    ["Outcome", demo.outcome ?? "not known", demo.outcome_reason ?? ""],
    ["Duration", number(report.duration_s, "s"), `${report.samples} samples at ${number(report.rate_hz, "Hz", 0)}`],
    ["Path length", number(report.path_length_mm, "mm", 1), "tremor included"],
    ["Extent x, y, z", triple(report.extent_mm), ""],
    ["States of the path", `${report.path_states}`, `${report.revisits} visited again; in ${report.grid.chosen === "paper" ? "the paper's" : "a fitted"} grid of ${report.grid.shape.join(" × ")} cells of ${report.grid.cell_mm} mm`],
    ["Lost to the grid x, y, z", triple(report.discretisation_rmse_mm), "RMSE between the recording and its cells"],
    ["Clutch", `${report.clutch_presses} presses`, `${number(report.undriven_s, "s")} not driven, left out`],
  ];
  get("made-numbers").replaceChildren(...rows.map((row) => rowOf(...row)));
  get("advice").replaceChildren(advice(report.advice));
  get("report").href = `${root}/demos/${demo.id}/report`;
  get("score").href = `${root}/pages/demos/${demo.id}/score`;
  get("trained").hidden = true;
  tell("train-said", "");
  get("made").hidden = false;
  get("made").focus();
}

function advice(said) {
  const list = document.createElement(said.length ? "ul" : "p");
  list.className = said.length ? "advice" : "fine";
  if (!said.length) list.textContent = "This is a good demonstration to learn from.";
  for (const one of said) {
    const item = document.createElement("li");
    item.textContent = one;
    list.append(item);
  }
  return list;
}

let version;
get("train").addEventListener("click", async () => {
  const button = get("train");
  const failed = ["recovery", "failure"].includes(demo.outcome);
  const means = "The version and its card name the outcome. It is not released by this.";
  if (failed && !(await confirmed({ what: `Learn from a demonstration that is marked ${demo.outcome}?`, means, yes: "Train" }))) return;
  button.disabled = true;
  button.parentElement.querySelectorAll(":scope ~ .running").forEach((one) => one.remove());
  tell("train-said", "");
  try {
    const job = await call("POST", "/trainings", { surgeon: demo.surgeon, suture: demo.suture, demos: [demo.id], ...(failed && { outcomes: "any" }) });
    const ended = await watch(job.id, jobLine(button.parentElement));
    if (ended.state !== "succeeded") return;
    version = ended.result.policy_version;
    const passes = ended.result.releasable;
    tell("train-said", passes ? `Version ${version} was learnt and passes the gate.` : `Version ${version} was learnt; it does not pass the gate, see the reasons on the style's page.`, passes ? "well" : "wrong");
    get("release").textContent = `Release version ${version}`;
    get("release").hidden = !passes;
    get("see").href = `${root}/pages/styles/${demo.surgeon}/${demo.suture}?version=${version}`;
    get("trained").hidden = false;
  } catch (problem) {
    tell("train-said", problem.message);
  } finally {
    button.disabled = false;
  }
});

get("release").addEventListener("click", async () => {
  tell("release-said", "");
  try {
    await call("POST", `/policies/${demo.surgeon}/${demo.suture}/versions/${version}/release`);
    tell("release-said", `Version ${version} is released and served to the clients of this style.`, "well");
    get("release").hidden = true;
  } catch (problem) {
    tell("release-said", problem.message);
  }
});
