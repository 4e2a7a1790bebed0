// The list of proposed hand-offs: accepts, corrects and rejects them, and draws their paths.
import { call } from "./api.js";
import { confirmed, drawing, element } from "./site.js";

const chosen = document.getElementById("cut");
const items = [...document.querySelectorAll(".proposals > li")];
const KEPT = "proposals";

// Choices for the whole list last as long as the tab.
if (chosen) {
  const { surgeon, suture, session } = chosen.elements;
  const kept = JSON.parse(sessionStorage.getItem(KEPT) ?? "{}");
  for (const [field, value] of [[surgeon, kept.surgeon], [suture, kept.suture], [session, kept.session]]) {
    if (value && (field.tagName === "INPUT" || [...field.options].some((one) => one.value === value))) field.value = value;
  }
  const askNew = () => (document.getElementById("new").hidden = surgeon.value !== "+");
  askNew();
  chosen.addEventListener("change", () => {
    askNew();
    sessionStorage.setItem(KEPT, JSON.stringify({ surgeon: surgeon.value, suture: suture.value, session: session.value }));
  });
  chosen.addEventListener("submit", (event) => event.preventDefault());
}

// The surgeon of a proposal: the chosen one, who is added if new; null if a question was answered with no.
async function surgeonOf(item) {
  const { surgeon, pseudonym } = chosen.elements;
  const named = item.dataset.surgeon;
  if (!surgeon.reportValidity()) throw new Error("Give the surgeon's pseudonym at the top of the list.");
  if (!surgeon.value && !named) throw new Error("The recording names no surgeon; choose one at the top of the list.");
  if (!surgeon.value) return named;
  if (surgeon.value === "+" && (!pseudonym.value || !pseudonym.reportValidity())) throw new Error("Give the new surgeon's pseudonym at the top of the list.");
  const wanted = surgeon.value === "+" ? pseudonym.value : surgeon.value;
  const means = `The recording was uploaded for ${named}. The demonstration will be ${wanted}'s.`;
  if (named && named !== wanted && !(await confirmed({ what: `Is this hand-off ${wanted}'s?`, means, yes: "Yes, cut it" }))) return null;
  if (surgeon.value === "+") {
    if (![...surgeon.options].some((one) => one.value === wanted)) {
      await call("PUT", `/surgeons/${wanted}`, {}, { "If-None-Match": "*" }); // never in place of one that there is
      surgeon.add(new Option(wanted, wanted), surgeon.options.length - 1);
    }
    surgeon.value = wanted;
    chosen.dispatchEvent(new Event("change"));
  }
  return wanted;
}

async function accept(item, form) {
  const { start_s: start, end_s: end, outcome, outcome_reason: why } = form.elements;
  const { suture, session } = chosen.elements;
  if (!suture.value) throw new Error("Choose the suture type at the top of the list.");
  if (!session.reportValidity()) return;
  const surgeon = await surgeonOf(item);
  if (surgeon === null) return;
  const demo = await call("POST", `/recordings/${item.dataset.recording}/demos`, {
    surgeon, suture: suture.value, arm: item.dataset.arm, start_s: Number(start.value), end_s: Number(end.value),
    ...(session.value && { session: session.value }), ...(outcome.value && { outcome: outcome.value }), ...(why.value && { outcome_reason: why.value }),
  });
  settle(item, "accepted", `Cut for ${surgeon}: ${demo.report.path_states} states, ${demo.report.duration_s.toFixed(1)} s.${demo.report.advice.map((one) => ` ${one}`).join("")}`);
}

async function decide(item, form, state) {
  const note = form.elements.note?.value;
  await call("PUT", `/recordings/${item.dataset.recording}/proposals/${item.dataset.number}`, { state, ...(note && { note }) });
  if (state === "open") location.reload();
  else settle(item, state, "Rejected. It is listed under this state, and can be opened again there.");
}

// Show the new state in the place of the form, and go on with the next open proposal.
function settle(item, state, words) {
  const badge = item.querySelector(".badge");
  badge.textContent = state;
  badge.className = `badge ${state === "accepted" ? "released" : "job-failed"}`;
  const said = element("p", { className: "said well", tabIndex: -1 }, words);
  said.setAttribute("role", "status");
  item.querySelector("form").replaceWith(said);
  const next = items.slice(items.indexOf(item) + 1).find((one) => one.querySelector("form button"));
  (next?.querySelector("form button:not([data-decide])") ?? said).focus({ preventScroll: false });
}

for (const item of items) {
  const form = item.querySelector("form");
  const run = (work) => async (event) => {
    event.preventDefault();
    const buttons = form.querySelectorAll("button");
    const place = form.querySelector(".said");
    place.textContent = "";
    buttons.forEach((one) => (one.disabled = true));
    try {
      await work();
    } catch (problem) {
      place.className = "said wrong";
      place.textContent = problem.message;
    } finally {
      buttons.forEach((one) => (one.disabled = false));
    }
  };
  form?.addEventListener("submit", run(() => accept(item, form)));
  form?.querySelectorAll("[data-decide]").forEach((one) => one.addEventListener("click", run(() => decide(item, form, one.dataset.decide))));
}

// Draw the paths as the thumbnails of styles are seen: from above one corner, in a square of 100 units.
const ACROSS = [[0.94, -0.34, 0], [0.14, 0.4, 0.91]];

function draw(svg, points) {
  const seen = points.map((point) => ACROSS.map((axis) => axis.reduce((sum, part, k) => sum + part * point[k], 0)));
  if (!seen.length) return;
  const [low, high] = [0, 1].map((k) => seen.map((one) => one[k])).reduce(([lows, highs], values) => [[...lows, Math.min(...values)], [...highs, Math.max(...values)]], [[], []]);
  const scale = 84 / Math.max(high[0] - low[0], high[1] - low[1], 1);
  const at = ([u, v]) => [50 + scale * (u - (low[0] + high[0]) / 2), 50 - scale * (v - (low[1] + high[1]) / 2)].map((one) => one.toFixed(1));
  const [first, last] = [at(seen[0]), at(seen.at(-1))];
  svg.replaceChildren(
    drawing("polyline", { class: "path", points: seen.map((one) => at(one).join(",")).join(" ") }),
    drawing("circle", { class: "start", cx: first[0], cy: first[1], r: 3 }),
    drawing("circle", { class: "goal", cx: last[0], cy: last[1], r: 4 }),
  );
}

for (const recording of new Set(items.map((one) => one.dataset.recording))) {
  try {
    const { paths_mm: paths } = await call("GET", `/pages/recordings/${recording}/proposals`);
    for (const item of items.filter((one) => one.dataset.recording === recording)) draw(item.querySelector("svg"), paths[item.dataset.number - 1] ?? []);
  } catch {
    // without a picture the proposal can still be decided
  }
}
document.body.dataset.drawn = "true";
