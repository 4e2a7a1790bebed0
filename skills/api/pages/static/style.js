// The 3-D view of a style: the recorded motion, its path in the grid, and the learnt policy, by layers.
import { call } from "./api.js";
import { Scene, box, dots, layerList, line, shade } from "./scene.js";
import { percent, say } from "./site.js";

const place = document.getElementById("style");
const { view: address, rollouts, version } = place.dataset;
const get = (id) => document.getElementById(id);
// Cividis, which looks alike to readers with every common colour vision, from few moves to many; on a dark background
// its dark end would be invisible, so it begins lighter there.
const CIVIDIS = [[0, "#00224e"], [0.25, "#3b496c"], [0.5, "#7d7c78"], [0.75, "#bcae6c"], [1, "#fee838"]];
const ON_DARK = [[0, "#5b7bb5"], [0.5, "#9c9b8e"], [0.75, "#c9bb70"], [1, "#fee838"]];
const scale = () => (getComputedStyle(document.documentElement).colorScheme === "dark" ? ON_DARK : CIVIDIS);
// A colour, line style and number for each learnt path.
const WAYS = [["learnt", "solid"], ["other", "dash"], ["reward", "longdash"], ["goal", "dot"], ["recorded", "dashdot"]];

const layers = [
  { id: "recorded", name: "Recorded motion", shape: "line", colour: "recorded", on: true },
  { id: "path", name: "Path in the grid", shape: "squares", colour: "path", on: true },
  { id: "learnt", name: "Learnt paths", shape: "dashes", colour: "learnt", on: true },
  { id: "rewards", name: "Rewards", shape: "circles", colour: "reward", on: false },
  { id: "starts", name: "Starts that are covered", shape: "cells", colour: "box", on: true },
  { id: "box", name: "The grid world", shape: "box", colour: "box", on: true },
  { id: "ends", name: "Start and goal", shape: "ends", colour: "goal", on: true },
];
const followed = [];
let view, scene;
let heights = []; // of the cells, mm

try {
  view = await call("GET", address);
  if (!version) for (const id of ["learnt", "starts"]) layers.splice(layers.findIndex((one) => one.id === id), 1);
  layerList(get("layers"), layers, () => scene.redraw());
  if (version) prepareStarts();
  scene = new Scene(traces, { picked: (at) => follow([...at]) });
  await scene.drawn;
  if (version) await follow(view.path_mm[0], "the demonstrated start");
} catch (problem) {
  say(get("view"), problem.message);
}

function traces() {
  const on = Object.fromEntries(layers.map((layer) => [layer.id, layer.on]));
  const drawn = [];
  if (on.box) drawn.push(line(box(view.grid), { colour: "box", width: 1 }));
  if (on.starts) drawn.push(...starts());
  if (on.rewards) drawn.push(rewards());
  if (on.recorded) drawn.push(line(view.recorded_mm, { name: "recorded", colour: "recorded", width: 2.5 }));
  if (on.path) drawn.push(...path());
  if (on.learnt) drawn.push(...followed.flatMap(learnt));
  if (on.ends) drawn.push(...ends());
  return drawn;
}

function path() {
  return [
    line(view.path_mm, { colour: "path", width: 3.5 }),
    dots(view.path_mm, { name: "path in the grid", colour: "path", symbol: "square", size: 3.5 }),
  ];
}

function ends() {
  const [first, last] = [view.path_mm[0], view.path_mm.at(-1)];
  return [
    dots([first], { name: "start", colour: "start", symbol: "diamond", size: 9 }),
    dots([last], { name: "goal: the hand-off", colour: "goal", symbol: "cross", size: 9 }),
  ];
}

function rewards() {
  const { at_mm: at, of, goal } = view.rewards;
  const size = of.map((value) => (value === goal ? 9 : 5));
  return dots(at, { name: "reward", colour: "reward", size, opacity: 0.55, hover: (i) => `reward ${of[i]}` });
}

function learnt({ path_mm: points, number }) {
  const [name, dash] = WAYS[(number - 1) % WAYS.length];
  return [
    line(points, { name: `learnt path ${number}`, colour: name, width: 4, dash }),
    dots([points[0]], { name: `start ${number}`, colour: name, size: 6, symbol: "diamond-open", text: [`${number}`] }),
  ];
}

// The cells from which the policy reaches the goal; those from which it does not are crosses, in every colouring.
function starts() {
  const { at_mm: at, reaches, nearest, moves, share } = view.starts;
  const height = heights[Number(get("slice").value)];
  const shown = at.map((_, i) => i).filter((i) => height === undefined || at[i][2] === height);
  const some = (wanted) => shown.filter(wanted);
  const narrow = get("view").clientWidth < 500;
  const size = height !== undefined ? 6 : narrow ? 1.6 : 2.6;
  const told = (which, name, look) => dots(which.map((i) => at[i]), {
    name, size, opacity: height === undefined ? 0.4 : 0.9, ...look, picks: which.map((i) => at[i]),
    hover: (i) => `${percent(share[which[i]])} of the demonstration\n${moves[which[i]]} moves to the goal`,
  });
  const lost = told(some((i) => !reaches[i]), "does not reach the goal", { colour: "learnt", symbol: "x", opacity: 1, size: 4 });
  const by = get("starts-of").value;
  if (by !== "kind") {
    const covered = some((i) => reaches[i]);
    const [value, most] = by === "share" ? [share, 1] : [moves, Math.max(1, ...moves)];
    return [told(covered, "reaches the goal", { colours: covered.map((i) => shade(scale(), value[i] / most)), symbol: "square" }), lost];
  }
  return [
    told(some((i) => reaches[i] && nearest[i]), "joins in the fewest moves", { colour: "path", symbol: "square" }),
    told(some((i) => reaches[i] && !nearest[i]), "takes a longer way", { colour: "reward", symbol: "diamond", opacity: 0.8 }),
    lost,
  ];
}

function prepareStarts() {
  const { at_mm: at, every, reaches, nearest, moves, share } = view.starts;
  heights = [...new Set(at.map((point) => point[2]))].sort((a, b) => a - b);
  get("slice").max = heights.length - 1;
  const count = (which) => which.filter(Boolean).length;
  const key = () => {
    const lost = reaches.length - count(reaches);
    const mean = share.reduce((sum, one) => sum + one, 0) / share.length;
    const words = {
      share: () => `■ blue follows little of the demonstration, yellow all of it: ${percent(mean)} on average; ${count(reaches.map((yes, i) => yes && share[i] === 0))} see the goal alone; `,
      moves: () => `■ blue is near, yellow far: 0 to ${Math.max(...moves)} moves to the goal; `,
      kind: () => `■ ${count(nearest)} join the path in the fewest moves, ◆ ${count(reaches.map((yes, i) => yes && !nearest[i]))} take a longer way, `,
    };
    get("starts-key").textContent = `${words[get("starts-of").value]()}✕ ${lost} do not reach it.${every > 1 ? ` One cell in ${every} along each axis is shown.` : ""}`;
  };
  key();
  get("starts-of").addEventListener("change", () => {
    key();
    scene.redraw();
  });
  get("slice").addEventListener("input", () => {
    const height = heights[Number(get("slice").value)];
    get("slice-at").textContent = height === undefined ? "all" : `z = ${height} mm`;
    scene.redraw();
  });
  get("start").addEventListener("submit", (event) => {
    event.preventDefault();
    const form = new FormData(event.target);
    follow(["x", "y", "z"].map((axis) => Number(form.get(axis))));
  });
}

async function follow(start_mm, words) {
  say(get("start-said"), "");
  try {
    const rollout = await call("POST", rollouts, { start_mm, version: Number(version) });
    const number = 1 + Math.max(0, ...followed.map((one) => one.number));
    followed.push({ ...rollout, number, words });
    list();
    await scene.redraw();
  } catch (problem) {
    say(get("start-said"), problem.message);
  }
}

function list() {
  get("starts").replaceChildren(
    ...followed.map((one) => {
      const item = document.createElement("li");
      const words = document.createElement("span");
      const from = one.path_mm[0].join(", ");
      words.textContent = `${one.number}: from ${from} mm${one.words ? `, ${one.words}` : ""}; ${one.states.length - 1} moves, ${one.finished ? "reaches the goal" : "does not reach the goal"}`;
      const button = document.createElement("button");
      button.className = "quiet";
      button.type = "button";
      button.textContent = "Remove";
      button.setAttribute("aria-label", `Remove path ${one.number}`);
      button.addEventListener("click", () => {
        followed.splice(followed.indexOf(one), 1);
        list();
        scene.redraw();
      });
      item.append(words, button);
      return item;
    }),
  );
}
