// From a recording to a verdict on one page: each step of the job as it is done, questions, and remedies as buttons.
import { call, digestOf, root, send, watch } from "./api.js";
import { takeFolders } from "./folder.js";
import { element, say } from "./site.js";

const get = (id) => document.getElementById(id);
const form = get("try");
const [file, steps, bar, go] = ["try-file", "try-steps", "try-progress", "try-go"].map(get);
let asked = {};

function chosen() {
  if (file.files.length) get("try-chosen").textContent = file.files[0].name;
}

file.addEventListener("change", chosen);
takeFolders(get("try-drop"), file, get("try-folder"));

async function addSurgeon(surgeon) {
  if (!("adds" in form.dataset)) return;
  const { items } = await call("GET", `/surgeons?limit=200&search=${surgeon}`);
  if (items.some((one) => one.surgeon === surgeon)) return;
  // never in place of one that there is
  await call("PUT", `/surgeons/${surgeon}`, {}, { "If-None-Match": "*" });
}

// One step: its name and text, and where it leads.
function line(step) {
  const item = element("li", { className: step.state }, element("strong", {}, step.name), ` ${step.text}`);
  for (const one of step.remedies) if (typeof one === "string") item.append(` ${one}`);
  if (step.name === "plan" && step.id)
    item.append(" ", element("a", { href: `${root}/pages/plans/${step.id}` }, "See the plan"));
  return item;
}

function button({ words, change }, then) {
  const made = element("button", { type: "button" }, words[0].toUpperCase() + words.slice(1));
  if (change.release && !("releases" in form.dataset)) {
    made.disabled = true;
    made.title = "This needs the role releaser.";
  }
  made.addEventListener("click", () => then(change));
  return made;
}

// The fields of a question that is answered together with others: a number, or one of the choices.
function field(step) {
  const legend = element("legend", {}, step.text);
  if (step.name === "tissue") {
    const input = element("input", { type: "number", step: "any", name: "tissue_mm", placeholder: "not known" });
    return element("fieldset", {}, legend, element("label", {}, "Height in mm; empty: not known ", input));
  }
  const radios = step.choices.map(({ words, change }) => {
    const input = element("input", { type: "radio", name: step.name, value: JSON.stringify(change), required: true });
    return element("label", {}, input, ` ${words}`);
  });
  return element("fieldset", {}, legend, ...radios);
}

// The open questions: the choices of the last one are buttons that go on.
function questions(open) {
  const place = element("li", { className: "asks" });
  const last = open.at(-1).name === "tissue" ? null : open.at(-1);
  const inner = element("form", {}, ...open.filter((one) => one !== last).map(field));
  const next = (change) => {
    if (!inner.reportValidity()) return;
    const fields = Object.fromEntries(new FormData(inner));
    const answers = { ...change };
    for (const [name, value] of Object.entries(fields)) {
      if (name === "tissue_mm") answers.tissue_mm = value === "" ? "none" : Number(value);
      else Object.assign(answers, JSON.parse(value));
    }
    run(answers);
  };
  inner.addEventListener("submit", (event) => event.preventDefault());
  const choices = last ? last.choices : [{ words: "go on", change: {} }];
  inner.append(...(last ? [element("p", {}, last.text)] : []), element("div", { className: "row" }, ...choices.map((one) => button(one, next))));
  place.append(inner);
  return place;
}

function show(job) {
  const told = job.result?.steps ?? [];
  const over = !["queued", "running"].includes(job.state);
  const open = over ? told.filter(({ state }) => state === "asks") : [];
  bar.hidden = over;
  if (job.progress) bar.value = job.progress;
  else bar.removeAttribute("value");
  steps.replaceChildren(
    ...told.filter(({ state }) => state !== "asks").map((step) => {
      const item = line(step);
      if (over && step.choices.length) item.append(element("div", { className: "row" }, ...step.choices.map((one) => button(one, run))));
      return item;
    }),
    ...(open.length ? [questions(open)] : []),
  );
  if (over && job.error && !told.some(({ state }) => state === "refused")) say(get("try-said"), job.error);
}

async function run(change) {
  asked = { ...asked, ...change };
  steps.querySelectorAll("button").forEach((one) => (one.disabled = true));
  bar.hidden = false;
  try {
    show(await watch((await call("POST", "/tries", asked)).id, show));
  } catch (problem) {
    bar.hidden = true;
    steps.querySelectorAll("button").forEach((one) => (one.disabled = false));
    say(go.parentElement, problem.message);
  }
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const [surgeon, suture] = [get("try-surgeon").value, get("try-suture").value];
  say(go.parentElement, "");
  steps.replaceChildren();
  go.disabled = true;
  bar.hidden = false;
  try {
    await addSurgeon(surgeon);
    const headers = { "Content-Type": "application/octet-stream", ...(await digestOf(file.files[0])) };
    const query = new URLSearchParams({ surgeon });
    const stored = await send("/recordings", file.files[0], headers, query, (went, all) => (bar.value = went / all));
    asked = { recording: stored.sha256, surgeon, suture };
    await run({});
  } catch (problem) {
    bar.hidden = true;
    say(go.parentElement, problem.message);
  } finally {
    go.disabled = false;
  }
});
