"""The typed client: every call of the service as a method.

    with Client("http://127.0.0.1:8000") as client:
        demo = client.add_demo(Path("hand-off.mcap"), surgeon="kestrel", suture="simple-running")
        client.wait(client.train("kestrel", "simple-running", release=True))
        policy = client.policy("kestrel", "simple-running")

Answers are the JSON of the service. What it refuses is raised as `Problem`.
"""

import base64
import hashlib
import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Literal, Self

import httpx2 as httpx

from skills.errors import SkillsError

Json = dict[str, Any]
Position = Sequence[float]
PIECE_BYTES = 1 << 20
ENDED = ("succeeded", "failed", "cancelled")


class Problem(SkillsError):
    """What the service refused: its status, its kind, and what to do next."""

    def __init__(self, status: int, body: Json) -> None:
        why = "; ".join(f"{one['where']}: {one['why']}" for one in body.get("errors", ()))
        super().__init__(f"{body.get('detail', 'The service refused.')} {why}".strip(), **body)
        self.status = status
        self.kind = str(body.get("type", "")).rpartition(":")[2]


class JobFailed(SkillsError):
    """A job that was waited for did not succeed; `job` is what became of it."""

    def __init__(self, job: Json) -> None:
        super().__init__(f"The {job['kind']} {job['state']}: {job['error'] or 'no reason was given'}")
        self.job = job


class Client:
    """The service at an address, or behind any `httpx.Client` (such as one that calls the application in-process)."""

    def __init__(self, server: str | httpx.Client, timeout_s: float = 60.0) -> None:
        self.http = httpx.Client(base_url=server, timeout=timeout_s) if isinstance(server, str) else server

    def __enter__(self) -> Self:
        """Use it in a with block."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        self.http.close()

    # ---- catalogue

    def put_surgeon(self, surgeon: str, **about: Any) -> Json:
        """Write a surgeon: skill_level, handedness, protocol, consent."""
        return self._json("PUT", f"/surgeons/{surgeon}", json=about)

    def surgeon(self, surgeon: str) -> Json:
        """Look a surgeon up."""
        return self._json("GET", f"/surgeons/{surgeon}")

    def erase_surgeon(self, surgeon: str) -> None:
        """Erase a surgeon and all that was derived from them, for good."""
        self.send("DELETE", f"/surgeons/{surgeon}")

    def suture_types(self) -> list[Json]:
        """List the catalogue."""
        return self._all("/suture-types")

    # ---- recordings and demonstrations

    def add_recording(
        self,
        recording: Path | bytes,
        media_type: str | None = None,
        sent: Callable[[int], None] | None = None,
        **query: Any,
    ) -> Json:
        """Store a recording: its digest, its topics and the hand-offs proposed in it.

        Args:
            recording: A file, which is never held in memory, or bytes. They are sent with their digest.
            media_type: What they are; left out, it is told by the content.
            sent: Is told of bytes as they go out.
            query: `rate_hz` and `frame`, for a table.
        """
        return self._upload("/recordings", recording, media_type, query, sent)

    def add_demo(
        self,
        recording: Path | bytes,
        *,
        surgeon: str,
        suture: str,
        media_type: str | None = None,
        sent: Callable[[int], None] | None = None,
        **query: Any,
    ) -> Json:
        """Store a recording and one demonstration of it: arm, topic, start_s, end_s, grid, cell_mm, hysteresis."""
        return self._upload("/demos", recording, media_type, {"surgeon": surgeon, "suture": suture, **query}, sent)

    def cut_demo(self, recording: str, *, surgeon: str, suture: str, **asked: Any) -> Json:
        """Cut a demonstration out of a stored recording, named by its digest; it is asked for as in `add_demo`."""
        body = {"surgeon": surgeon, "suture": suture, **_given(asked)}
        return self._json("POST", f"/recordings/{recording}/demos", json=body)

    def demos(self, surgeon: str | None = None, suture: str | None = None) -> list[Json]:
        """List demonstrations, the newest first."""
        return self._all("/demos", surgeon=surgeon, suture=suture)

    def demo(self, demo: str) -> Json:
        """Look a demonstration up."""
        return self._json("GET", f"/demos/{demo}")

    def demo_report(self, demo: str) -> Json:
        """Get a demonstration with its report, measured anew."""
        return self._json("GET", f"/demos/{demo}/report")

    def demo_report_page(self, demo: str) -> bytes:
        """Get a demonstration's report as a page, which needs nothing from outside."""
        return self.send("GET", f"/demos/{demo}/report", headers={"Accept": "text/html"}).content

    def demo_path(self, demo: str) -> Json:
        """Get a demonstration's states, and its motion as it was recorded."""
        return self._json("GET", f"/demos/{demo}/path")

    def demo_recording(self, demo: str) -> bytes:
        """Get the recording's bytes back."""
        return self.send("GET", f"/demos/{demo}/recording").content

    def withdraw_demo(self, demo: str, *, erase: bool = False) -> None:
        """Withdraw a demonstration, or erase it and all that was derived from it."""
        self.send("DELETE", f"/demos/{demo}", params={"erase": erase})

    # ---- trainings and jobs

    def train(self, surgeon: str, suture: str, **asked: Any) -> Json:
        """Ask for a style to be trained: demos, learner, seed, release."""
        return self._json("POST", "/trainings", json={"surgeon": surgeon, "suture": suture, **_given(asked)})

    def retrain(self, **asked: Any) -> Json:
        """Ask for styles to be trained again, as one job: surgeon, suture, only_stale, learner, release."""
        return self._json("POST", "/retrainings", json=_given(asked))

    def retraining(self, job: str) -> Json:
        """Look a batch up: its job, and in `styles` how many are in which state."""
        return self._json("GET", f"/retrainings/{job}", params={"limit": 1})

    def retrained(self, job: str, state: str | None = None) -> list[Json]:
        """List the styles of a batch, all or those of one state: queued, done, failed, cancelled."""
        return self._all(f"/retrainings/{job}", state=state)

    def job(self, job: str) -> Json:
        """Look a job up."""
        return self._json("GET", f"/jobs/{job}")

    def cancel(self, job: str) -> Json:
        """Cancel a job."""
        return self._json("DELETE", f"/jobs/{job}")

    def wait(self, job: Json, timeout_s: float = 600.0) -> Json:
        """Wait until a job has ended, and give it back.

        Raises:
            JobFailed: It failed, was cancelled, or takes longer than `timeout_s`.
        """
        deadline, pause = time.monotonic() + timeout_s, 0.05
        while job["state"] not in ENDED and time.monotonic() < deadline:
            time.sleep(pause)
            pause = min(0.5, pause * 1.3)
            job = self.job(job["id"])
        if job["state"] != "succeeded":
            raise JobFailed(job)
        return job

    # ---- policies

    def policies(self) -> list[Json]:
        """List what is served."""
        return self._all("/policies")

    def policy(self, surgeon: str, suture: str, version: int | None = None) -> Json:
        """Get the released policy of a style, or one of its versions."""
        path = f"/policies/{surgeon}/{suture}"
        return self._json("GET", path if version is None else f"{path}/versions/{version}")

    def policy_arrays(self, policy: str) -> bytes:
        """Get a policy version's arrays, an .npz with the Q values, by its digest."""
        return self.send("GET", f"/policy-versions/{policy}", headers={"Accept": "application/x-npz"}).content

    def versions(self, surgeon: str, suture: str) -> list[Json]:
        """List the versions of a style, the newest first."""
        return self._all(f"/policies/{surgeon}/{suture}/versions")

    def release(self, surgeon: str, suture: str, version: int) -> Json:
        """Release a version."""
        return self._json("POST", f"/policies/{surgeon}/{suture}/versions/{version}/release")

    def withdraw(self, surgeon: str, suture: str) -> None:
        """Withdraw what is released."""
        self.send("DELETE", f"/policies/{surgeon}/{suture}/release")

    def rollout(self, surgeon: str, suture: str, start_mm: Position, version: int | None = None) -> Json:
        """Follow a policy from a place."""
        body = {"start_mm": list(start_mm), "version": version}
        return self._json("POST", f"/policies/{surgeon}/{suture}/rollouts", json=body)

    def next(self, surgeon: str, suture: str, position_mm: Position, phase: int | None = None) -> Json:
        """Ask what the released policy would do at a place."""
        body = {"position_mm": list(position_mm), "phase": phase}
        return self._json("POST", f"/policies/{surgeon}/{suture}/next", json=body)

    # ---- plans and playbacks

    def plan(self, surgeon: str, suture: str, suture_points: Sequence[Mapping[str, Any]], **asked: Any) -> Json:
        """Stack a style at suture points.

        Beside them: version, starts_mm, arm, frame, instrument, speed_mm_s, rate_hz, tip_offset_mm, psm_m, realignment.
        """
        points = [dict(point) for point in suture_points]
        body = {"surgeon": surgeon, "suture": suture, "suture_points": points, **_given(asked)}
        return self._json("POST", "/plans", json=body)

    def suture_points(self, scene: Path | bytes, arm: str | None = None, frame: str | None = None) -> Json:
        """Read the Entry and Exit marks of a simulator's MCAP file, in an arm's base frame."""
        return self._upload("/suture-points", scene, None, {"arm": arm, "frame": frame}, None)

    def plan_of(self, plan: str) -> Json:
        """Look a plan up."""
        return self._json("GET", f"/plans/{plan}")

    def trajectory(self, plan: str, pass_index: int | None = None) -> Json:
        """Get a plan's motion, sampled; or that of one pass, counted from 0."""
        return self._json("GET", f"/plans/{plan}/trajectory", params=_given({"pass": pass_index}))

    def replay_bag(self, plan: str, pass_index: int | None = None) -> bytes:
        """Get the bag that a robot replays, a zip; or that of one pass, counted from 0.

        Raises:
            Problem: It is 409 while the plan may not be replayed, and says why.
        """
        how = {"headers": {"Accept": "application/zip"}, "params": _given({"pass": pass_index})}
        return self.send("GET", f"/plans/{plan}/trajectory", **how).content

    def compare(self, plan: str, demo: str, pass_index: int = 0) -> Json:
        """Compare a pass of a plan, counted from 0, with a demonstration that is the recording of its replay."""
        return self._json("GET", f"/plans/{plan}/comparison", params={"demo": demo, "pass": pass_index})

    def play(self, plan: str) -> Json:
        """Ask for a plan to be played in the simulator."""
        return self._json("POST", "/playbacks", json={"plan": plan})

    def playback(self, playback: str) -> Json:
        """Get the simulator's verdict."""
        return self._json("GET", f"/playbacks/{playback}")

    def picture(self, playback: str) -> bytes:
        """Get the picture of a playback, a PNG."""
        return self.send("GET", f"/playbacks/{playback}/picture.png").content

    def draw(self, playback: str) -> Json:
        """Ask for the film and the plots of a playback: the job to wait for, which each new playback starts itself."""
        return self._json("POST", f"/playbacks/{playback}/pictures")

    def animation(self, playback: str, kind: Literal["mp4", "gif"] = "mp4") -> bytes:
        """Get the film of a playback, once it is drawn."""
        return self.send("GET", f"/playbacks/{playback}/animation.{kind}").content

    def plot(self, playback: str, of: Literal["joints", "clearance"]) -> bytes:
        """Get a plot of a playback over time, a PNG, once it is drawn."""
        return self.send("GET", f"/playbacks/{playback}/{of}.png").content

    # ---- how

    def send(self, method: str, path: str, **how: Any) -> httpx.Response:
        """Send a request, and raise what is refused.

        Raises:
            Problem: The service refused.
        """
        answer = self.http.request(method, path, **how)
        if answer.is_success or answer.status_code == httpx.codes.NOT_MODIFIED:
            return answer
        is_problem = answer.headers.get("content-type", "").startswith("application/problem+json")
        raise Problem(answer.status_code, answer.json() if is_problem else {"detail": answer.reason_phrase})

    def _json(self, method: str, path: str, **how: Any) -> Json:
        body: Json = self.send(method, path, **how).json()
        return body

    def _all(self, path: str, **query: Any) -> list[Json]:
        items: list[Json] = []
        cursor: Any = None
        while True:
            page = self._json("GET", path, params=_given({"limit": 200, "cursor": cursor, **query}))
            items += page["items"]
            cursor = page["next"]
            if cursor is None:
                return items

    def _upload(
        self,
        path: str,
        recording: Path | bytes,
        media_type: str | None,
        query: Mapping[str, Any],
        sent: Callable[[int], None] | None,
    ) -> Json:
        from skills.recordings import media_type_of  # slow to import

        with io.BytesIO(recording) if isinstance(recording, bytes) else recording.open("rb") as file:
            size, digest = _digest(file)
            headers = {
                "Content-Type": media_type or media_type_of(file),
                "Content-Digest": f"sha-256=:{digest}:",
                "Content-Length": str(size),
            }
            return self._json("POST", path, content=_pieces(file, sent), headers=headers, params=_given(query))


def _digest(file: BinaryIO) -> tuple[int, str]:
    """Return the size of a file, and its SHA-256 in base64."""
    seen, size = hashlib.sha256(), 0
    for data in _pieces(file, None):
        seen.update(data)
        size += len(data)
    return size, base64.b64encode(seen.digest()).decode()


def _pieces(file: BinaryIO, sent: Callable[[int], None] | None) -> Iterator[bytes]:
    file.seek(0)
    while data := file.read(PIECE_BYTES):
        yield data
        if sent is not None:
            sent(len(data))


def _given(query: Mapping[str, Any]) -> Json:
    return {name: value for name, value in query.items() if value is not None}
