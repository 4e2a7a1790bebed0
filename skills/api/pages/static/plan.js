// The 3-D view of a plan, the live view of its playback, and the film once it is drawn.
import { call, watch } from "./api.js";
import { Scene, box, dots, layerList, line } from "./scene.js";
import { jobLine, say } from "./site.js";

const place = document.getElementById("plan");
const grid = JSON.parse(place.dataset.grid);
const goal = JSON.parse(place.dataset.goal);
// One trace per pass, with its number, counted from 0 as in reports.
const COLOURS = ["path", "learnt", "goal", "other", "reward", "recorded"];

const layers = [
  { id: "passes", name: "Paths of the passes", shape: "line", colour: "path", on: true },
  { id: "transfers", name: "Transfers to the next start", shape: "dashes", colour: "box", on: true },
  { id: "points", name: "Suture points", shape: "ends", colour: "goal", on: true },
  { id: "boxes", name: "Grid worlds", shape: "box", colour: "box", on: false },
];
let passes = [];

function turned([x, y, z, w], [a, b, c]) {
  return [
    (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - z * w) * b + 2 * (x * z + y * w) * c,
    2 * (x * y + z * w) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - x * w) * c,
    2 * (x * z - y * w) * a + 2 * (y * z + x * w) * b + (1 - 2 * (x * x + y * y)) * c,
  ];
}

function traces() {
  const on = Object.fromEntries(layers.map((layer) => [layer.id, layer.on]));
  return passes.flatMap((pass, index) => {
    const name = COLOURS[index % COLOURS.length];
    const drawn = [];
    if (on.passes) {
      drawn.push(line(pass.path_mm, { name: `pass ${index}`, colour: name, width: 3.5 }));
      drawn.push(dots([pass.path_mm[0]], { name: `start of pass ${index}`, colour: name, symbol: "diamond-open", size: 5 }));
    }
    if (on.points) drawn.push(dots([pass.position_mm], { name: `suture point ${index}`, colour: name, symbol: "cross", size: 5, text: [`${index}`] }));
    if (on.transfers && index > 0) drawn.push(line([passes[index - 1].path_mm.at(-1), pass.path_mm[0]], { name: `to pass ${index}`, colour: "box", width: 1.5, dash: "dash" }));
    if (on.boxes) {
      const moved = (corner) => turned(pass.rotation_xyzw, corner.map((value, i) => value - goal[i])).map((value, i) => value + pass.position_mm[i]);
      drawn.push(line(box(grid, moved), { colour: "box", width: 1 }));
    }
    return drawn;
  });
}

const button = document.getElementById("play");
const playSaid = document.getElementById("play-said");

async function follow(id) {
  button.disabled = true;
  const job = await watch(id, jobLine(playSaid));
  if (job.state === "succeeded") location.reload();
  else button.disabled = false;
}

function wrong(problem) {
  playSaid.textContent = problem.message;
  playSaid.className = "said wrong";
  button.disabled = false;
}

button.addEventListener("click", async () => {
  button.disabled = true;
  try {
    const job = await call("POST", "/playbacks", {
      plan: place.dataset.plan.split("/").pop(),
      errors: document.getElementById("errors").value || null,
    });
    if (job.state === "succeeded") location.reload();
    else await follow(job.id);
  } catch (problem) {
    wrong(problem);
  }
});
if (button.dataset.job) follow(button.dataset.job).catch(wrong);

for (const drawing of document.querySelectorAll(".drawing")) {
  watch(drawing.dataset.job, () => {}).then(() => location.reload(), (problem) => say(drawing, problem.message));
}

try {
  ({ passes } = await call("GET", place.dataset.plan));
  const scene = new Scene(traces);
  layerList(document.getElementById("layers"), layers, () => scene.redraw());
} catch (problem) {
  say(document.getElementById("view"), problem.message);
}
