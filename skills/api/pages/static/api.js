// The calls of the service, from a page: one way to ask, one kind of error, one way to watch a job.

const meta = (name) => document.querySelector(`meta[name="${name}"]`)?.content ?? "";
export const root = meta("root");

export class Problem extends Error {
  constructor(status, body) {
    const wrong = (body.errors ?? []).map((one) => `${one.where || "The request"}: ${one.why}`);
    const reasons = body.reasons ?? [];
    super([body.detail || body.title || `The server answered ${status}.`, ...wrong, ...reasons].join(" "));
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

export async function ask(method, path, { json, accept = "application/json" } = {}) {
  const headers = { Accept: accept, ...(method === "GET" ? {} : changing()) };
  if (json !== undefined) headers["Content-Type"] = "application/json";
  const body = json === undefined ? undefined : JSON.stringify(json);
  let answer;
  try {
    answer = await fetch(root + path, { method, headers, body, credentials: "same-origin" });
  } catch {
    throw new Problem(0, { detail: "The server cannot be reached; see whether it runs, then try again." });
  }
  if (!answer.ok) throw await problemOf(answer.status, await answer.text());
  return answer;
}

export async function call(method, path, json) {
  const answer = await ask(method, path, { json });
  return answer.status === 204 ? null : answer.json();
}

// Save an answer as a file; the type is chosen by Accept, which a link cannot do.
export async function save(path, accept, name) {
  const answer = await ask("GET", path, { accept });
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await answer.blob());
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

export const ACTIVE = ["queued", "running"];

// Follow a job to its end, telling each change; the last one is returned.
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
