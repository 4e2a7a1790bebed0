// Upload of a recording as raw bytes with their digest: a preview of what is understood, and then, unchanged, its storage.
import { digestOf, root, send } from "./api.js";
import { takeFolders } from "./folder.js";
import { understood } from "./preview.js";

const get = (id) => document.getElementById(id);
const form = get("upload");
const said = get("said");
const KINDS = Object.fromEntries([...get("kind").options].map((one) => [one.dataset.suffix, one.value]));
const TABLE = "text/csv";
const FRAMELESS = [TABLE, "application/zip"]; // the latter: LeRobot
const mebibytes = (bytes) => `${(bytes / 2 ** 20).toFixed(bytes < 2 ** 20 ? 3 : 1)} MiB`;

function chosen() {
  const [file] = get("file").files;
  if (!file) return;
  const kind = KINDS[`.${file.name.split(".").pop().toLowerCase()}`];
  if (kind) get("kind").value = kind;
  get("chosen").textContent = `${file.name}, ${mebibytes(file.size)}`;
}

function changed() {
  const kind = get("kind").value;
  said.hidden = !FRAMELESS.includes(kind);
  for (const one of said.querySelectorAll(".of-table")) one.hidden = kind !== TABLE;
  get("seen").hidden = true;  // it was of another file, or read with other answers
  tell("upload-said", "");
}

function tell(id, text) {
  get(id).textContent = text;
  get(id).className = text ? "said wrong" : "said";
}

get("file").addEventListener("change", chosen);
form.addEventListener("input", changed);
form.addEventListener("change", changed);

takeFolders(get("drop"), get("file"), get("folder"));

// The answers to what the file does not say, of the fields that its format has.
function answers() {
  const query = new URLSearchParams();
  if (said.hidden) return query;
  for (const field of said.querySelectorAll("[name]")) {
    if (field.closest("[hidden]")) continue;
    for (const line of field.value.split("\n")) if (line.trim()) query.append(field.name, line.trim());
  }
  return query;
}

function sending(path, file, headers, query) {
  const request = new XMLHttpRequest();
  get("stop").onclick = () => request.abort();
  return send(path, file, headers, query, (went, total) => {
    get("progress").value = went / total;
    get("sent").textContent = went < total ? `${mebibytes(went)} of ${mebibytes(total)}` : "Sent; it is being read and checked.";
  }, request);
}

// Send the file with everything locked, so that what is stored is what was previewed.
async function sent(path, where, then, more = {}) {
  const [file] = get("file").files;
  const kind = get("kind").value;
  const query = answers();
  for (const [name, value] of Object.entries(more)) if (value) query.append(name, value);
  const fields = [...form.elements, get("store"), get("change")].filter((one) => !one.disabled && one !== get("stop"));
  for (const one of fields) one.disabled = true;
  get("progress").value = 0;
  get("progress").hidden = get("stop").hidden = false;
  tell(where, "");
  try {
    const answer = await sending(path, file, { "Content-Type": kind, ...(await digestOf(file)) }, query);
    for (const one of fields) one.disabled = false;
    then(answer);
  } catch (problem) {
    for (const one of fields) one.disabled = false;
    tell(where, problem.message);
    if (!said.hidden && problem.status === 422) said.open = true;
  } finally {
    get("sent").textContent = "";
    get("progress").hidden = get("stop").hidden = true;
  }
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  get("seen").hidden = true;
  sent("/recordings/preview", "upload-said", (seen) => {
    get("understood").replaceChildren(...understood(seen));
    get("store").disabled = !seen.timed;
    tell("store-said", seen.timed ? "" : "It has no times, so it is stored only with a rate, or with the column of its times.");
    get("seen").hidden = false;
    get("seen").focus();
  });
});

get("store").addEventListener("click", () => {
  const surgeon = get("surgeon").value;
  sent("/recordings", "store-said", (stored) => {
    const more = new URLSearchParams(Object.entries({ surgeon, suture: form.dataset.suture }).filter(([, value]) => value));
    location.assign(`${root}/pages/recordings/${stored.id}${more.size ? `?${more}` : ""}`);
  }, { surgeon });
});

get("change").addEventListener("click", () => {
  if (!said.hidden) said.open = true;
  (said.hidden ? get("file") : said.querySelector("[name]")).focus();
});

if (get("file").files.length) chosen();  // kept by the browser when the page is opened again
changed();
