// The calls of the service from a page: requests, one class of error, and following a job.

const meta = (name) => document.querySelector(`meta[name="${name}"]`)?.content ?? "";
export const root = meta("root");

export class Problem extends Error {
  constructor(status, body) {
    const wrong = (body.errors ?? []).map((one) => `${one.where || "The request"}: ${one.why}`);
    const reasons = body.reasons ?? [];
    const advice = (body.remedies ?? []).filter((one) => typeof one === "string");  // the others are data for programs
    const said = body.reason && [body.reason, ...advice].join(" ");
    super([said || body.detail || body.title || `The server answered ${status}.`, ...wrong, ...reasons].join(" "));
    this.status = status;
    this.body = body;
  }
}

export const changing = () => (meta("csrf-token") ? { "X-CSRF-Token": meta("csrf-token") } : {});

export async function problemOf(status, text) {
  try {
    return new Problem(status, JSON.parse(text));
  } catch {
    return new Problem(status, { detail: `The server answered ${status} and no reason; try again.` });
  }
}

export async function ask(method, path, { json, accept = "application/json", more = {} } = {}) {
  const headers = { Accept: accept, ...more, ...(method === "GET" ? {} : changing()) };
  if (json !== undefined) headers["Content-Type"] = "application/json";
  const body = json === undefined ? undefined : JSON.stringify(json);
  let answer;
  try {
    answer = await fetch(root + path, { method, headers, body, credentials: "same-origin" });
  } catch {
    throw new Problem(0, { detail: "The server cannot be reached; check that it runs, then try again." });
  }
  if (!answer.ok) throw await problemOf(answer.status, await answer.text());
  return answer;
}

export async function call(method, path, json, more) {
  const answer = await ask(method, path, { json, more });
  return answer.status === 204 ? null : answer.json();
}

// Save a response as a file; a link could not set Accept, which selects the type.
export async function save(path, accept, name) {
  const answer = await ask("GET", path, { accept });
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await answer.blob());
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

const DIGESTED_BYTES = 512 * 2 ** 20; // the digest needs the complete file in memory; a larger file is sent without one

export async function digestOf(file) {
  if (file.size > DIGESTED_BYTES || !crypto.subtle) return {};
  const digest = await crypto.subtle.digest("SHA-256", await file.arrayBuffer());
  return { "Content-Digest": `sha-256=:${btoa(String.fromCharCode(...new Uint8Array(digest)))}:` };
}

// Send a file as the body; `tell` gets the bytes that went and all, and `request` can be aborted meanwhile.
export function send(path, file, headers, query, tell, request = new XMLHttpRequest()) {
  const done = new Promise((resolve, reject) => {
    request.upload.onprogress = ({ loaded, total }) => tell(loaded, total);
    request.onload = () => resolve(request);
    request.onerror = () => reject(new Error("The connection was lost; send it again. A file that was stored already is not stored twice."));
    request.onabort = () => reject(new Error("Stopped."));
  }).then(async ({ status, responseText: text }) => {
    if (status >= 300) throw await problemOf(status, text);
    return JSON.parse(text);
  });
  request.open("POST", `${root}${path}?${query}`);
  for (const [name, value] of Object.entries({ ...headers, ...changing() })) request.setRequestHeader(name, value);
  request.send(file);
  return done;
}

export const ACTIVE = ["queued", "running"];

// Follow a job to its end with a callback for each change; returns the last state.
export function watch(id, tell) {
  return new Promise((resolve, reject) => {
    const source = new EventSource(`${root}/jobs/${id}/events`);
    source.addEventListener("job", (event) => {
      const job = JSON.parse(event.data);
      tell(job);
      if (ACTIVE.includes(job.state)) return;
      source.close();
      resolve(job);
    });
    source.addEventListener("error", async () => {
      source.close();
      try {
        for (;;) {
          const job = await call("GET", `/jobs/${id}`);
          tell(job);
          if (!ACTIVE.includes(job.state)) return resolve(job);
          await new Promise((wake) => setTimeout(wake, 1000));
        }
      } catch (problem) {
        reject(problem);
      }
    });
  });
}
