// Upload of a recording as raw bytes with their digest, with a progress bar.
import { changing, problemOf, root } from "./api.js";

const get = (id) => document.getElementById(id);
const form = get("upload");
const KINDS = Object.fromEntries([...get("kind").options].map((one) => [one.dataset.suffix, one.value]));
const TABLE = "text/csv";
const FRAMELESS = [TABLE, "application/zip"]; // the latter: LeRobot
const DIGESTED_BYTES = 512 * 2 ** 20; // the digest needs the complete file in memory; a larger file is sent without one
const mebibytes = (bytes) => `${(bytes / 2 ** 20).toFixed(1)} MiB`;

function chosen() {
  const [file] = get("file").files;
  if (!file) return;
  const kind = KINDS[`.${file.name.split(".").pop().toLowerCase()}`];
  if (kind) get("kind").value = kind;
  get("chosen").textContent = `${file.name}, ${mebibytes(file.size)}`;
  ofKind();
}
function ofKind() {
  for (const one of form.querySelectorAll(".of-table")) one.hidden = get("kind").value !== TABLE;
  get("of-frame").hidden = !FRAMELESS.includes(get("kind").value);
}
get("file").addEventListener("change", chosen);
get("kind").addEventListener("change", ofKind);

const drop = get("drop");
for (const name of ["dragover", "dragleave", "drop"]) {
  drop.addEventListener(name, (event) => {
    event.preventDefault();
    drop.classList.toggle("over", name === "dragover");
    if (name !== "drop" || !event.dataTransfer.files.length) return;
    get("file").files = event.dataTransfer.files;
    chosen();
  });
}

async function digestOf(file) {
  if (file.size > DIGESTED_BYTES || !crypto.subtle) return {};
  const digest = await crypto.subtle.digest("SHA-256", await file.arrayBuffer());
  return { "Content-Digest": `sha-256=:${btoa(String.fromCharCode(...new Uint8Array(digest)))}:` };
}

function send(file, headers, query) {
  const request = new XMLHttpRequest();
  const done = new Promise((resolve, reject) => {
    request.upload.onprogress = ({ loaded, total }) => {
      get("progress").value = loaded / total;
      get("sent").textContent = loaded < total ? `${mebibytes(loaded)} of ${mebibytes(total)}` : "Sent; it is being read and checked.";
    };
    request.onload = async () =>
      request.status < 300 ? resolve(JSON.parse(request.responseText)) : reject(await problemOf(request.status, request.responseText));
    request.onerror = () => reject(new Error("The connection was lost; send it again. Nothing was stored."));
    request.onabort = () => reject(new Error("Stopped; nothing was stored."));
  });
  request.open("POST", `${root}/recordings?${query}`);
  for (const [name, value] of Object.entries({ ...headers, ...changing() })) request.setRequestHeader(name, value);
  get("stop").onclick = () => request.abort();
  request.send(file);
  return done;
}

function sayAbout(query) {
  if (get("rate").value) query.set("rate_hz", get("rate").value);
  for (const name of ["table_arm", "instrument", "decimal"]) if (get(name).value) query.set(name, get(name).value);
  for (const line of get("column").value.split("\n")) if (line.trim()) query.append("column", line.trim());
  for (const unit of get("unit").value.split(/[\s,]+/)) if (unit) query.append("unit", unit);
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const [file] = get("file").files;
  const kind = get("kind").value;
  const query = new URLSearchParams();
  if (kind === TABLE) sayAbout(query);
  if (FRAMELESS.includes(kind) && get("frame").value) query.set("frame", get("frame").value);
  const button = form.querySelector("button:not([type])");
  button.disabled = true;
  get("progress").hidden = get("stop").hidden = false;
  get("upload-said").textContent = "";
  get("upload-said").className = "said";
  try {
    const stored = await send(file, { "Content-Type": kind, ...(await digestOf(file)) }, query);
    const more = new URLSearchParams(Object.entries({ surgeon: form.dataset.surgeon, suture: form.dataset.suture }).filter(([, value]) => value));
    location.assign(`${root}/pages/recordings/${stored.id}${more.size ? `?${more}` : ""}`);
  } catch (problem) {
    get("upload-said").textContent = problem.message;
    get("upload-said").className = "said wrong";
    get("sent").textContent = "";
  } finally {
    button.disabled = false;
    get("progress").hidden = get("stop").hidden = true;
  }
});
