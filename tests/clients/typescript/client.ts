// What a program does with the types that openapi-typescript made: `node built/client.js URL TABLE SUTURE`.
import { readFile } from "node:fs/promises";
import createClient from "openapi-fetch";
import type { components, paths } from "./api.js";

type Job = components["schemas"]["Job"];

const [url, table, suture] = process.argv.slice(2) as [string, string, string];
const client = createClient<paths, "application/json">({ baseUrl: url });
const files = createClient<paths, "application/octet-stream" | "application/x-npz">({ baseUrl: url });
const style = { surgeon: "wren", suture };

function must<T>(answer: { data?: T; error?: unknown; response: Response }): T {
  if (answer.data === undefined) throw new Error(`${answer.response.status} ${JSON.stringify(answer.error)}`);
  return answer.data;
}

async function done(job: Job): Promise<Record<string, unknown>> {
  const until = Date.now() + 300_000;
  while (job.state === "queued" || job.state === "running") {
    if (Date.now() > until) throw new Error("the job takes too long");
    await new Promise((resume) => setTimeout(resume, 200));
    job = must(await client.GET("/jobs/{job}", { params: { path: { job: job.id } } }));
  }
  if (job.state !== "succeeded" || job.result === null) throw new Error(`${job.state}: ${job.error}`);
  return job.result;
}

const bytes = await readFile(table);
const raw = {
  body: "" as string,
  bodySerializer: () => bytes,
  headers: { "Content-Type": "text/csv" },
};

must(await client.PUT("/surgeons/{surgeon}", { params: { path: { surgeon: "wren" } }, body: {} }));
const recording = must(await client.POST("/recordings", raw));
if (recording.left_out.length !== 0) throw new Error("a table has no topic to leave out");
const demo = must(await client.POST("/demos", { ...raw, params: { query: style } }));
if (demo.recording !== recording.sha256) throw new Error("another recording");
const asked = must(await client.POST("/trainings", { body: { ...style, release: true } }));
if ((await done(asked))["released"] !== true) throw new Error("not released");
const policy = must(await client.GET("/policies/{surgeon}/{suture}", { params: { path: style } }));

const arrays = must(
  await files.GET("/policies/{surgeon}/{suture}", {
    params: { path: style },
    headers: { Accept: "application/x-npz" },
    parseAs: "arrayBuffer",
  }),
);
if (new TextDecoder().decode(arrays.slice(0, 2)) !== "PK") throw new Error("no arrays");
const back = must(
  await files.GET("/demos/{demo}/recording", { params: { path: { demo: demo.id } }, parseAs: "arrayBuffer" }),
);
if (!Buffer.from(back).equals(bytes)) throw new Error("other bytes");
const plan = must(
  await client.POST("/plans", { body: { ...style, suture_points: [{ position_mm: policy.goal_mm }], handoff: "none" } }),
);
const played = await done(must(await client.POST("/playbacks", { body: { plan: plan.sha256 } })));
const picture = must(
  await files.GET("/playbacks/{playback}/picture.png", {
    params: { path: { playback: String(played["playback"]) } },
    parseAs: "arrayBuffer",
  }),
);
if (Buffer.from(picture).toString("latin1", 1, 4) !== "PNG") throw new Error("no picture");
console.log(`version ${policy.version} phases ${policy.phases} demonstration ${policy.demos[0]}`);
