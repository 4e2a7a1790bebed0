// The form that starts a batch, and the live view of a running job.
import { call, root, watch } from "./api.js";

const batch = document.getElementById("batch");
batch?.addEventListener("submit", async (event) => {
  event.preventDefault();
  const { surgeon, suture, only_stale: stale, release } = batch.elements;
  const said = document.getElementById("batch-said");
  said.textContent = "";
  said.className = "said";
  try {
    const job = await call("POST", "/retrainings", { surgeon: surgeon.value || null, suture: suture.value || null, only_stale: stale.checked, release: release.checked });
    location.assign(`${root}/pages/jobs/${job.id}`);
  } catch (problem) {
    said.textContent = problem.message;
    said.className = "said wrong";
  }
});

const job = document.getElementById("job");
if (job) {
  const bar = job.querySelector("progress");
  await watch(job.dataset.job, ({ state, progress }) => {
    if (state === "running" && progress > 0) bar.value = progress;
  });
  location.reload();
}
