"""Calls of trainings and jobs, of policies (versions, releases, cards, rollouts), of atlases, and of scores.

A downloaded policy is verified: the service sends the policy and its metadata, the policy is rebuilt from them, and
their digest is computed again. Whoever changed a number, in transit or in the store, would have to change the digest
too, and the digest is the one that is cited.
"""

import io
import json
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import aclosing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import httpx2 as httpx

from skills.client.connection import (
    Connection,
    JobFailed,
    JobTakesLonger,
    NotReached,
    NotUnderstood,
    Problem,
    at,
    call,
    given,
)
from skills.client.transport import keep
from skills.errors import BadInput, Corrupt
from skills.schemas.cards import PolicyCard
from skills.schemas.given import Atlas, Nearest, Progress, RecognisedRecording, Score, SignedEnvelope
from skills.schemas.operation import Job
from skills.schemas.policies import NextStep, Policy, PolicySummary, Rollout, Version
from skills.schemas.pose_styles import NextPose, PoseStyle
from skills.schemas.training import RetrainedStyle, Retraining
from skills.schemas.tries import TryStep

if TYPE_CHECKING:
    from skills.learning.policy import Policy as LearntPolicy

State = Literal["queued", "running", "succeeded", "failed", "cancelled"]
Kind = Literal["training", "retraining", "playback", "pictures", "dataset", "try"]
Combining = Literal["medoid", "barycentre", "corridor"]
Watcher = Callable[[Job], None]

ENDED = ("succeeded", "failed", "cancelled")
PAUSES_S = (0.05, 0.5)  # between two polls of a job: the first pause, and the longest
EVENTS = "text/event-stream"
JSON, NPZ = "application/json", "application/x-npz"
# Fields of a version or of its response, which the digest of a policy does not cover.


def steps_of(job: Job) -> list[TryStep]:
    """Return the steps of a try so far."""
    return [TryStep.model_validate(one) for one in (job.result or {}).get("steps", ())]


class Jobs(Connection):
    """Calls of trainings and jobs."""

    @call
    async def train(
        self,
        surgeon: str,
        suture: str,
        *,
        demos: Sequence[str] | None = None,
        combine: Combining | None = None,
        learner: Mapping[str, Any] | None = None,
        seed: int = 0,
        release: bool = False,
        outcomes: Literal["success", "any"] = "success",
        depth_along: Sequence[float] | None = None,
        scene: Mapping[str, Any] | None = None,
        scene_costs: Mapping[str, float] | None = None,
    ) -> Job:
        """Request the training of a style; an equal request returns the same job.

        The job's `did` states the effect of the request. With `release`, the request is not retried after a lost
        connection, because somebody may have decided otherwise in between.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            demos: Digests of the demonstrations to learn from; default: the newest one that is active and not
                marked recovery or failure.
            combine: Method that combines several demonstrations into one path; default: a corridor.
            learner: Its `kind` and settings; default: Q-learning in the phase state.
            seed: Seed of the exploration.
            release: Release the version if it passes the gate; also if an equal training is done already and its
                version is
                not the one that the style serves now.
            outcomes: "any" learns also from demonstrations that are marked recovery or failure.
            depth_along: The direction in which depth increases, of a demonstration in another frame than its arm's
                base; of equally short ways the policy takes the shallower one.
            scene: What must not be touched, as `Scene.as_json` writes it; the learner's `slip` counts in it.
            scene_costs: Costs of the scene by name; default: those of `skills.gridworld.scene.SceneCosts`.
        """
        asked = {"surgeon": surgeon, "suture": suture, "seed": seed, "release": release}
        how = None if combine is None else {"kind": combine}
        asked |= given({"demos": demos, "combine": how, "learner": learner, "depth_along": depth_along})
        asked |= given({"outcomes": outcomes, "scene": scene, "scene_costs": scene_costs})
        return await self._ask(Job, "POST", at("trainings"), asked, harmless=not release)

    @call
    async def try_recording(
        self,
        recording: str,
        surgeon: str,
        suture: str,
        *,
        segment: Literal["whole"] | int | None = None,
        loss_mm: float | None = None,
        cell_mm: float | None = None,
        hysteresis: float | None = None,
        release: bool | None = None,
        tissue_mm: float | Literal["none"] | None = None,
        errors: Literal["calibrated", "uncalibrated"] | Mapping[str, Any] | None = None,
        psm_m: Mapping[str, Any] | None = None,
    ) -> Job:
        """Request a stored recording's way to a verdict: cut, learnt, certified, released if wanted, planned, played.

        The job's result has the `steps`, read by `steps_of`, also while it runs. The job ends with a question where one
        is open: send it again with one of the step's choices, whose `change` has keywords of this call.

        Args:
            recording: The recording's digest.
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            segment: The proposed hand-off, counted from 1, or "whole"; asked if there are several.
            loss_mm: The coarsest cells are chosen that lose at most this much, RMSE in 3-D; default: 2.6.
            cell_mm: Length of a cell's edge, in place of the choice.
            hysteresis: In cells, in place of the choice.
            release: Whether to release the version if it passes the gate; asked.
            tissue_mm: Height of level tissue in the arm's frame, or "none"; asked.
            errors: Errors of the arms that are to play it, as for `play`; asked.
            psm_m: The arm that takes the needle, as for `plan`.
        """
        asked: dict[str, Any] = {
            "recording": recording,
            "surgeon": surgeon,
            "suture": suture,
            "segment": segment,
            "psm_m": psm_m,
        }
        asked |= {"loss_mm": loss_mm, "cell_mm": cell_mm, "hysteresis": hysteresis, "release": release}
        asked |= {"tissue_mm": tissue_mm, "errors": errors}
        return await self._ask(Job, "POST", at("tries"), given(asked), harmless=release is not True)

    @call
    async def retrain(
        self,
        *,
        surgeon: str | None = None,
        suture: str | None = None,
        only_stale: bool = False,
        learner: Mapping[str, Any] | None = None,
        release: bool = False,
    ) -> Job:
        """Request the training of styles again, as one job: all, or those of a surgeon or of a suture type.

        With `release`, the request is not retried after a lost connection, as with `train`.
        """
        asked = {"surgeon": surgeon, "suture": suture, "only_stale": only_stale, "learner": learner, "release": release}
        return await self._ask(Job, "POST", at("retrainings"), given(asked), harmless=not release)

    @call
    async def retraining(self, job: str) -> Retraining:
        """Return a batch: its job, and in `styles` the number of styles in each state."""
        return await self._get(Retraining, at("retrainings", job), limit=1)

    @call
    async def retrained(
        self, job: str, state: Literal["queued", "done", "failed", "cancelled"] | None = None
    ) -> list[RetrainedStyle]:
        """List the styles of a batch, all or those of one state."""
        return await self._all(RetrainedStyle, at("retrainings", job), state=state)

    @call
    async def job(self, job: str) -> Job:
        """Return a job."""
        return await self._get(Job, at("jobs", job))

    @call
    async def jobs(self, state: State | None = None, kind: Kind | None = None) -> list[Job]:
        """List jobs, the newest first."""
        return await self._all(Job, at("jobs"), state=state, kind=kind)

    @call
    async def cancel(self, job: str) -> Job:
        """Cancel a job."""
        return await self._ask(Job, "DELETE", at("jobs", job))

    @call
    async def wait(self, job: Job | str, timeout_s: float = 600.0, progress: Watcher | None = None) -> Job:
        """Wait until a job has ended, and return it.

        Changes are received as server-sent events; if the stream fails, the job is polled instead.

        Args:
            job: The job, or its id.
            timeout_s: Longest time to wait.
            progress: Called with the job at each change.

        Raises:
            JobTakesLonger: It has not ended in time.
            JobFailed: It failed or was cancelled.
        """
        deadline_s = self._clock() + timeout_s
        told: Job | None = None
        async with aclosing(self._seen(job if isinstance(job, str) else job.id, deadline_s)) as looks:
            async for seen in looks:
                if progress is not None and seen != told:
                    progress(seen)
                told = seen
                if seen.state == "succeeded":
                    return seen
                if seen.state in ENDED:
                    raise JobFailed(seen)
        assert told is not None
        raise JobTakesLonger(told, timeout_s)

    async def _seen(self, job: str, deadline_s: float) -> AsyncGenerator[Job, None]:
        """Yield the state of a job now, and again whenever it may have changed, until the deadline."""
        yield await self._get(Job, at("jobs", job))
        streams, pause_s = self._streams, PAUSES_S[0]
        while True:
            left_s = deadline_s - self._clock()
            if left_s <= 0:
                return
            if streams:
                try:
                    async with aclosing(self._events(job, left_s)) as events:
                        async for seen in events:
                            yield seen
                except httpx.ReadTimeout:
                    pass  # no event within the timeout
                except (Problem, NotUnderstood, ValueError, httpx.TransportError):
                    streams = False
            await self._transport.sleep(min(pause_s, max(0.0, deadline_s - self._clock())))
            pause_s = min(PAUSES_S[1], pause_s * 1.3)
            with suppress(NotReached):  # the service answered before, so it is restarting, and the job goes on
                yield await self._get(Job, at("jobs", job))

    async def _events(self, job: str, left_s: float) -> AsyncGenerator[Job, None]:
        """Yield the job of each server-sent event, until the stream or the time ends."""
        over_s = self._clock() + left_s
        patience_s = min(self._timeout_s, left_s)
        async with self._opened("GET", at("jobs", job, "events"), timeout_s=patience_s) as answer:
            if not answer.headers.get("content-type", "").startswith(EVENTS):
                return
            async with aclosing(self._transport.lines(answer)) as lines:
                async for line in lines:
                    if line.startswith("data:"):  # the service writes each event's data on one line
                        yield self._read(Job, json.loads(line.removeprefix("data:")))
                    if self._clock() >= over_s:  # heartbeats may continue for ever
                        return


# ---- policies, atlases and scores ----------------------------------------------------------------------------------


class Atlases(Connection):
    """Calls of atlases."""

    @call
    async def atlas(
        self, suture: str, *, scaled: bool = False, clusters: int | None = None, demo: str | None = None
    ) -> Atlas:
        """Return the atlas of a suture type.

        Args:
            suture: The suture type.
            scaled: Normalise size too; distances are then in units of the distance from start to goal.
            clusters: Number of clusters; default: as many as are found.
            demo: Digest of a demonstration in the atlas; the atlas then says whose style it resembles.
        """
        return await self._get(Atlas, at("styles", suture, "atlas"), scaled=scaled, clusters=clusters, demo=demo)

    @call
    async def nearest(self, demo: str, *, count: int = 10, scaled: bool = False) -> Nearest:
        """Return the demonstrations of the same suture type that are nearest to one, among all of them and exactly.

        Args:
            demo: Digest of the demonstration.
            count: Number of neighbours, at most 100.
            scaled: Normalise size too; distances are then in units of the distance from start to goal.
        """
        return await self._get(Nearest, at("demos", demo, "nearest"), count=count, scaled=scaled)

    @call
    async def recognise(self, recording: str, suture: str) -> RecognisedRecording:
        """Recognise the surgeon of a whole recording by all its movements, with its session left out.

        Args:
            recording: Digest of a recording that has a demonstration of the suture type.
            suture: The suture type.
        """
        return await self._get(RecognisedRecording, at("styles", suture, "recognition"), recording=recording)


class Scores(Connection):
    """Calls of scores."""

    @call
    async def score(
        self,
        surgeon: str,
        suture: str,
        *,
        demo: str | None = None,
        recording: str | None = None,
        arm: str | None = None,
        topic: str | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
        reference: str | None = None,
        task: str | None = None,
    ) -> Score:
        """Score a demonstration, or a part of a recording, against a style; nothing is stored. Not a credential.

        Args:
            surgeon: The surgeon whose style is the reference.
            suture: The suture type.
            demo: Digest of the demonstration to score; give either this or `recording`.
            recording: Digest of the recording of which a part is scored.
            arm: The arm in the recording.
            topic: The topic in the recording.
            start_s: Start of the part in the recording.
            end_s: End of the part.
            reference: The demonstration of the style to compare with; default: that of its released policy, else its
                newest.
            task: The task of the whole recording, for its rating; default: the only one of the calibration.
        """
        body = {
            **{"surgeon": surgeon, "suture": suture, "demo": demo, "recording": recording, "reference": reference},
            **{"arm": arm, "topic": topic, "start_s": start_s, "end_s": end_s, "task": task},
        }
        return await self._ask(Score, "POST", at("scores"), given(body))

    @call
    async def progress(self, surgeon: str, suture: str, *, against: str) -> Progress:
        """Compare a surgeon's demonstrations with a style's reference, session by session. Not a credential.

        Args:
            surgeon: The surgeon whose demonstrations are compared.
            suture: The suture type.
            against: The surgeon whose style is the reference.
        """
        return await self._get(Progress, at("surgeons", surgeon, "progress"), suture=suture, against=against)


Position = Sequence[float]


class Policies(Connection):
    """Calls of policies."""

    @call
    async def policies(self, surgeon: str | None = None, suture: str | None = None) -> list[PolicySummary]:
        """List the released policies."""
        return await self._all(PolicySummary, at("policies"), surgeon=surgeon, suture=suture)

    @call
    async def policy(self, surgeon: str, suture: str, version: int | None = None) -> Policy:
        """Return the released policy of a style, or one of its versions."""
        return await self._get(Policy, _path(surgeon, suture, version))

    @call
    async def policy_version(self, policy: str) -> Policy:
        """Return a policy version by the digest under which it is cited."""
        return await self._get(Policy, at("policy-versions", policy))

    @call
    async def learnt(self, surgeon: str, suture: str, version: int | None = None) -> "LearntPolicy":
        """Download a policy with its Q values, to be followed locally, and verify all of it against its digest.

            policy = client.learnt("kestrel", "simple-running")
            skills.rollout(policy, (-30, 25, -140)).tip_mm

        Raises:
            Corrupt: The arrays or the metadata do not match the digest.
        """
        _, _, policy = await self._verified(surgeon, suture, version)
        return policy

    @call
    async def save_policy(self, surgeon: str, suture: str, to: Path, version: int | None = None) -> Path:
        """Write a policy to a .json file, or to an .npz file with its Q values, after verifying it as `learnt` does.

        Raises:
            BadInput: The file name has neither suffix.
            Corrupt: The policy does not match its digest; no file is written.
        """
        if to.suffix not in (".json", ".npz"):
            raise BadInput(
                f"{to.name} ends in neither .json nor .npz.", "Name a .json file, or a .npz for its Q values."
            )
        said, arrays, _ = await self._verified(surgeon, suture, version)
        await self._transport.aside(lambda: keep(said if to.suffix == ".json" else arrays, to))
        return to

    @call
    async def policy_arrays(self, policy: str) -> bytes:
        """Return a policy version's arrays by its digest: an .npz with the Q values."""
        return await self._bytes(at("policy-versions", policy), NPZ)

    @call
    async def versions(self, surgeon: str, suture: str) -> list[Version]:
        """List the versions of a style, the newest first."""
        return await self._all(Version, at("policies", surgeon, suture, "versions"))

    @call
    async def policy_card(self, surgeon: str, suture: str, version: int) -> PolicyCard:
        """Return the card of a version: data, learner, figures, limits, and the digests of all that it rests on."""
        return await self._get(PolicyCard, at("policies", surgeon, suture, "versions", version, "card"))

    @call
    async def policy_signature(self, surgeon: str, suture: str) -> SignedEnvelope:
        """Return the service's signature of the files of the released policy: its JSON, arrays and pose style."""
        return await self._get(SignedEnvelope, at("policies", surgeon, suture, "signature"))

    @call
    async def policy_card_signature(self, surgeon: str, suture: str, version: int) -> SignedEnvelope:
        """Return the service's signature of the card of a version as it is now, as JSON and as a page."""
        return await self._get(
            SignedEnvelope, at("policies", surgeon, suture, "versions", version, "card", "signature")
        )

    @call
    async def save_signature(self, surgeon: str, suture: str, to: Path, card_of: int | None = None) -> Path:
        """Write the service's signature of the released policy to a file, or that of the card of a version."""
        path = ("signature",) if card_of is None else ("versions", card_of, "card", "signature")
        return await self._save(at("policies", surgeon, suture, *path), to, None, accept=JSON)

    @call
    async def save_policy_card(self, surgeon: str, suture: str, version: int, to: Path) -> Path:
        """Write the card of a version to a .json file, or to an .html file for people.

        Raises:
            BadInput: The file name has neither suffix.
        """
        if to.suffix not in (".json", ".html"):
            raise BadInput(f"{to.name} ends in neither .json nor .html.", "Name a .html for people, or a .json.")
        path = at("policies", surgeon, suture, "versions", version, "card")
        return await self._save(path, to, None, accept=JSON if to.suffix == ".json" else "text/html")

    @call
    async def release(self, surgeon: str, suture: str, version: int) -> Version:
        """Release a version, or an older one again.

        The request is not retried after a lost connection, because somebody may have released another version
        meanwhile.
        """
        path = at("policies", surgeon, suture, "versions", version, "release")
        return await self._ask(Version, "POST", path, harmless=False)

    @call
    async def withdraw(self, surgeon: str, suture: str) -> None:
        """Withdraw the released policy; like `release`, the request is not retried after a lost connection."""
        await self._send("DELETE", at("policies", surgeon, suture, "release"), harmless=False)

    @call
    async def rollout(self, surgeon: str, suture: str, start_mm: Position, version: int | None = None) -> Rollout:
        """Follow a policy from a position to the goal."""
        body = {"start_mm": list(start_mm), "version": version}
        return await self._ask(Rollout, "POST", at("policies", surgeon, suture, "rollouts"), body)

    @call
    async def next(self, surgeon: str, suture: str, position_mm: Position, phase: int | None = None) -> NextStep:
        """Return the next action of the released policy at a position; nothing moves."""
        body = {"position_mm": list(position_mm), "phase": phase}
        return await self._ask(NextStep, "POST", at("policies", surgeon, suture, "next"), body)

    @call
    async def pose_style(self, surgeon: str, suture: str) -> PoseStyle:
        """Return the pose style of the released policy: the poses of the hand along one phase, and the tube's proof."""
        return await self._get(PoseStyle, at("policies", surgeon, suture, "pose-style"))

    @call
    async def next_pose(
        self, surgeon: str, suture: str, position_mm: Position, rotation_xyzw: Sequence[float], phase: int | None = None
    ) -> NextPose:
        """Return the next pose of the released pose style at a pose; nothing moves.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            position_mm: Position of the tip in the frame of the pose style.
            rotation_xyzw: Its orientation, a unit quaternion.
            phase: The phase of the last answer; default: that of the nearest pose.
        """
        body = {"position_mm": list(position_mm), "rotation_xyzw": list(rotation_xyzw), "phase": phase}
        return await self._ask(NextPose, "POST", at("policies", surgeon, suture, "next"), body)

    async def _verified(self, surgeon: str, suture: str, version: int | None) -> tuple[bytes, bytes, "LearntPolicy"]:
        """Return a policy's JSON, its arrays, and the policy rebuilt from them and verified."""
        said = await self._bytes(_path(surgeon, suture, version), JSON)
        about = json.loads(said)
        arrays = await self._bytes(at("policy-versions", about["sha256"]), NPZ)
        demo = await self._json("GET", at("demos", about["demos"][0]))
        return said, arrays, await self._transport.aside(lambda: rebuilt(about, arrays, demo))


def _path(surgeon: str, suture: str, version: int | None) -> str:
    which = () if version is None else ("versions", version)
    return at("policies", surgeon, suture, *which)


def rebuilt(about: dict[str, Any], arrays: bytes, demo: dict[str, Any]) -> "LearntPolicy":
    """Return a policy, rebuilt from its JSON, its arrays, and the demonstration that it follows.

    Raises:
        Corrupt: It does not match its digest.
    """
    from skills.db.packed import digest  # here, because the library is slow to import
    from skills.library.policies.answers import live_actions_of
    from skills.schemas.policies import PhaseActions, PolicyManifest

    try:
        policy = _policy(about, arrays, demo)
        whole = PolicyManifest.model_validate(about).identity(digest(policy)) == about["sha256"]
        actions, live = about["actions"], about["live_actions"]
        told = actions is None or actions == policy.table().tolist()
        told = told and (live and [PhaseActions(**one) for one in live]) == live_actions_of(policy)
    except Exception as error:  # data of another kind can raise any class
        raise Corrupt("This version of the client cannot verify the received policy; update the client.") from error
    if not (whole and told):
        raise Corrupt("The received policy does not match its digest. Do not use it; fetch it again.")
    return policy


def _policy(about: dict[str, Any], arrays: bytes, demo: dict[str, Any]) -> "LearntPolicy":
    import numpy as np

    from skills.gridworld.domain import Domain
    from skills.gridworld.grid import GridPath, GridWorld
    from skills.gridworld.reward import RewardLevels
    from skills.gridworld.scene import Surroundings
    from skills.learning.dynamic_programming import ShortestWay
    from skills.learning.networks import Network
    from skills.learning.policy import Policy as LearntPolicy
    from skills.learning.policy import learner_of
    from skills.learning.q_learning import Training

    grid = GridWorld(**{name: about["grid"][name] for name in ("origin_mm", "cell_mm", "shape")})
    shown = about.get("combined") or demo["report"] | {"hysteresis": demo["hysteresis"]}
    bridged, hysteresis = shown.get("bridged_cells") or 0, shown["hysteresis"]
    path = GridPath(grid, np.array(about["waypoints"]), bridged=bridged, hysteresis=hysteresis)
    learner = learner_of({"kind": about["learner"], **about["settings"]})
    domain = Domain(path, learner.phased, learner.join_share)
    q = np.zeros((domain.n_rows, 27))
    with np.load(io.BytesIO(arrays), allow_pickle=False) as sent:
        q[domain.certified] = sent["q"]
        network = Network(sent["network"].tobytes()) if "network" in sent else None
    levels, training = RewardLevels(**about["reward_levels"]), Training(**about["training"])
    ties = ShortestWay(**about["ties"]) if about.get("ties") else None
    there = Surroundings.of_json(about["scene"]) if about.get("scene") else None
    return LearntPolicy(path, levels, learner, about["seed"], training, q, network, ties, there)
