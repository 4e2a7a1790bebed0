// Behaviour of every page: light and dark theme, buttons that make a call, confirmations, times, and polled parts.
import { ACTIVE, call, save, watch, root } from "./api.js";

const page = document.documentElement;
const themes = { "": "◐ auto", light: "☀ light", dark: "☾ dark" };

function showTheme() {
  document.getElementById("theme").textContent = themes[page.dataset.theme ?? ""];
}

document.getElementById("theme").addEventListener("click", () => {
  const order = Object.keys(themes);
  const next = order[(order.indexOf(page.dataset.theme ?? "") + 1) % order.length];
  if (next) page.dataset.theme = next;
  else delete page.dataset.theme;
  localStorage.setItem("theme", next);
  showTheme();
  document.dispatchEvent(new Event("theme"));
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => document.dispatchEvent(new Event("theme")));
showTheme();

// Show a message at its origin: in the element that `near` names, or right after it.
export function say(near, text, kind = "wrong") {
  let place = near.dataset.said ? document.getElementById(near.dataset.said) : near.parentElement.querySelector(":scope > .said");
  if (!place) {
    place = document.createElement("p");
    place.setAttribute("role", "alert");
    near.after(place);
  }
  place.className = `said ${text ? kind : ""}`;
  place.textContent = text;
  if (text) place.scrollIntoView({ block: "nearest" });
}

// Make an element of the page with properties and with texts or elements in it.
export function element(name, properties, ...inside) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...inside);
  return made;
}

// Make an element of a drawing.
export function drawing(name, attributes, text) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

// A share in percent, as the filter `share` words it: less than all is never 100 %, and more than nothing never 0 %.
export function percent(share, digits = 0) {
  const text = (100 * share).toFixed(digits), least = 10 ** -digits;
  if (share < 1 && Number(text) >= 100) return `> ${(100 - least).toFixed(digits)} %`;
  return share > 0 && Number(text) <= 0 ? `< ${least.toFixed(digits)} %` : `${text} %`;
}

// Make a row of a table of figures, as the macro `row` does.
export function rowOf(name, value, meaning) {
  const cell = element("td", {}, element("span", { className: "number" }, value), element("span", { className: "meaning" }, ` ${meaning}`));
  return element("tr", {}, element("th", { scope: "row" }, name), cell);
}

// Confirm an action that is hard to undo; if there is a word, it must be typed.
export function confirmed({ what, means, yes, word }) {
  const dialog = document.getElementById("ask");
  const [label, button] = [document.getElementById("ask-word"), document.getElementById("ask-yes")];
  const input = label.querySelector("input");
  document.getElementById("ask-what").textContent = what;
  document.getElementById("ask-means").textContent = means;
  button.textContent = yes;
  label.hidden = !word;
  label.querySelector("span").textContent = word ? `Type ${word} to go on` : "";
  input.value = "";
  const check = () => (button.disabled = Boolean(word) && input.value !== word);
  input.oninput = check;
  check();
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) =>
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true }),
  );
}

// Show a running job next to the element that requested it.
export function jobLine(near) {
  const line = document.createElement("p");
  line.className = "said running";
  const bar = document.createElement("progress");
  const words = document.createElement("span");
  line.append(bar, words);
  near.after(line);
  return (job) => {
    if (job.state === "running" && job.progress > 0) bar.value = job.progress;
    if (!ACTIVE.includes(job.state)) bar.value = job.state === "succeeded" ? 1 : (job.progress ?? 0);
    words.textContent = job.error ? `${job.state}: ${job.error}` : job.state;
    line.classList.toggle("wrong", job.state === "failed");
  };
}

async function act(button, about = button.dataset) {
  const { call: what, json, ask: question, means, yes, word, then } = about;
  if (question && !(await confirmed({ what: question, means, yes: yes ?? button.textContent.trim(), word }))) return;
  const [method, path] = what.split(" ");
  button.disabled = true;
  say(button, "");
  try {
    const answer = await call(method, path, json && JSON.parse(json));
    if (then === "job") {
      const job = await watch(answer.id, jobLine(button));
      if (job.state !== "succeeded") return;
    } else if (then === "jobs") {
      location.assign(`${root}/pages/jobs/${answer.id}`);
      return;
    }
    if (then?.startsWith("/")) location.assign(root + then);
    else location.reload();
  } catch (problem) {
    say(button, problem.message);
  } finally {
    button.disabled = false;
  }
}

async function saveFile(button) {
  const { file: path, accept, name } = button.dataset;
  say(button, "");
  button.disabled = true;
  try {
    await save(path, accept, name);
  } catch (problem) {
    say(button, problem.message);
  } finally {
    button.disabled = false;
  }
}

document.addEventListener("click", (event) => {
  const button = event.target.closest?.("button[data-call], button[data-file]");
  if (button?.dataset.call) act(button);
  else if (button) saveFile(button);
});

// The reason of an outcome is asked for where it is needed.
document.addEventListener("change", ({ target }) => {
  if (!target.matches?.('select[name="outcome"]')) return;
  const why = target.form.querySelector(".why");
  why.hidden = !["recovery", "failure"].includes(target.value);
  why.querySelector("input").required = !why.hidden;
  if (why.hidden) why.querySelector("input").value = "";
});

// A form with a call sends its filled fields as JSON; {name} in the path stands for the value of a field.
document.addEventListener("submit", (event) => {
  const form = event.target;
  if (!form.dataset.call) return;
  event.preventDefault();
  const fields = Object.fromEntries([...new FormData(form)].filter(([, value]) => value));
  const path = form.dataset.call.replace(/{(\w+)}/g, (_, name) => {
    const value = encodeURIComponent(fields[name]);
    delete fields[name];
    return value;
  });
  act(form.querySelector("button"), { ...form.dataset, call: path, json: JSON.stringify(fields) });
});

// A part of a page that changes by itself is fetched again as HTML until the server marks it as final.
async function renew(part) {
  while (part.dataset.renew) {
    await new Promise((wake) => setTimeout(wake, Number(part.dataset.renew)));
    if (document.hidden) continue;
    const answer = await fetch(location.href, { headers: { Accept: "text/html" } }).catch(() => null);
    if (!answer?.ok) continue;
    const now = new DOMParser().parseFromString(await answer.text(), "text/html").getElementById(part.id);
    if (!now) return;
    if (part.contains(document.activeElement)) continue; // the focus would be lost
    if (now.innerHTML !== part.innerHTML) part.replaceChildren(...now.childNodes);
    if (now.dataset.renew) part.dataset.renew = now.dataset.renew;
    else delete part.dataset.renew;
  }
}
document.querySelectorAll("[data-renew]").forEach(renew);
