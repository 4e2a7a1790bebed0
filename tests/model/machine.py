"""An installation under random actions of its users, compared with `tests.model.invariant` after every step.

A step is a tuple: the action and its arguments. Between any two transactions of a job, and of the atlas while it
measures, another action may happen: such a step contains another one, `(4, ("agree", ...))` being the action before
its fourth transaction. A step may also put an older copy of the database back, start with another signing key, or ask
another machine. Results that the service alone decides (digests, numbers of versions, whether a version passes
the gate, whether a batch finds it worse) are taken from its responses; the expected state comes from the model.

The calls go over HTTP to the application in this process; the machine is the worker, and does the command line's part
for backups. The date, the reader of uploads and the job engine are replaced (`tests.model.replaced`).
"""

import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from copy import copy
from datetime import timedelta
from pathlib import Path
from typing import Any, ClassVar

from hypothesis import strategies as st
from hypothesis.stateful import rule
from sqlalchemy import select

from skills.db.leaves import newest_checkpoint
from skills.db.models import Demonstration, Plan, PolicyVersion, StoredPlayback
from skills.db.service_tables import Job as JobRow
from skills.db.session import Database
from skills.errors import NotFound, SkillsError
from skills.jobs.attempts import Work
from skills.library.comparison.atlas import atlas_of
from skills.library.operation.backup import accept_rollback, back_up, restore
from skills.library.operation.erasure_list import keep_erasures, read_erasures
from skills.library.operation.history import Verified, sign_history, verify_history
from skills.library.operation.jobs import BATCH, PART
from skills.library.perform import perform_job
from skills.packing import sha256
from skills.settings import Settings
from skills.transparency.signing_keys import SigningKey
from tests import backends
from tests.api.service import CSV, Service
from tests.library import cases
from tests.library.test_replay import judged
from tests.model.checks import ACTIVE, FILES, PROPOSED, Compared
from tests.model.invariant import ALL_USES, Consent, Demo, Job, Key, Model, Style, Version
from tests.model.replaced import FIRST_DAY, Clock, Interruptible, settled
from tests.model.second_machine import SecondMachine, seen
from tests.put_back import copy_away, put_back

REQUESTS = ("train", "ask_training", "retrain", "ask_retraining")
SURGEONS = ("kestrel", "heron", "lark", "wren")
SUTURES = (cases.SUTURE, "horizontal-mattress")
MOST_BACKUPS, MOST_COPIES = 3, 2
CELL_MM = 5.0  # the default, so that a try cuts as `add_demo` does
WHY = "The needle fell."

Step = tuple[Any, ...]
Meanwhile = tuple[int, Step] | None


# ---- the steps ---------------------------------------------------------------------------------------------------


def step(name: str, *asked: Any) -> Any:
    return st.tuples(st.just(name), *asked)


INDEX, SEED = st.integers(0, 5), st.integers(0, 1)  # an index is taken modulo the number of existing objects
FLAG = st.sampled_from([True, True, True, False])
SURGEON = st.sampled_from(SURGEONS[:2] * 5 + SURGEONS)
SUTURE = st.sampled_from(SUTURES[:1] * 5 + SUTURES)
FILE = st.integers(0, len(FILES) - 1)
USES = st.sampled_from([None, None, None, frozenset(ALL_USES), frozenset({"training"}), frozenset({"atlas", "export"})])
DAYS = st.sampled_from([None, None, None, None, 0, 1, -1])  # the number of days from today that a consent covers
DEMOS = st.sampled_from(["newest", "oldest", "all"])

AGREE = step("agree", SURGEON, USES, DAYS)
ADD_DEMO = step("add_demo", SURGEON, SUTURE, FILE)
WITHDRAW_DEMO, ERASE_DEMO = step("withdraw_demo", INDEX), step("erase_demo", INDEX)
ERASE_SURGEON = step("erase_surgeon", st.sampled_from(SURGEONS), st.integers(0, 3))
MARK = step("mark", INDEX, st.sampled_from(["failure", "failure", "recovery", "success"]))
DECIDE = step("decide", st.sampled_from(["rejected", "rejected", "open"]), st.sampled_from([None, WHY]))
RELEASE, WITHDRAW, CANCEL = step("release", INDEX), step("withdraw", INDEX), step("cancel", INDEX)
PASS_A_DAY, BACK_UP = step("pass_a_day"), step("back_up")
ENDING = (WITHDRAW_DEMO, MARK, ERASE_DEMO, ERASE_SURGEON, WITHDRAW, CANCEL)
ELSEWHERE = (AGREE, ADD_DEMO, DECIDE, RELEASE, *ENDING, PASS_A_DAY, BACK_UP)
MEANWHILE = st.none() | st.tuples(st.integers(1, 8), st.one_of(*ELSEWHERE, AGREE, ERASE_DEMO))
ANY_OUTCOME = st.sampled_from([False, False, False, True])


def training(surgeon: str) -> Any:
    """Return a training during which, more often than anything else, this surgeon's consent to it ends."""
    ends = step("agree", st.just(surgeon), st.just(frozenset({"atlas", "export"})), st.none())
    meanwhile = st.none() | st.tuples(st.integers(1, 5), st.one_of(*ELSEWHERE, *[ends] * 4))
    return step("train", st.just(surgeon), SUTURE, DEMOS, SEED, FLAG, meanwhile, ANY_OUTCOME)


TRAIN = SURGEON.flatmap(training)


def trying(surgeon: str) -> Any:
    """Return a try during which, more often than anything else, its job or what it is about ends."""
    cancel, erase = step("cancel", st.just(-1)), step("erase_surgeon", st.just(surgeon), st.integers(0, 3))
    ends = step("agree", st.just(surgeon), st.just(frozenset({"atlas", "export"})), st.none())
    meanwhile = st.tuples(st.integers(1, 14), st.one_of(*ELSEWHERE, *[cancel, ERASE_DEMO] * 4, erase, ends))
    return step("try", st.just(surgeon), SUTURE, FILE, st.none() | meanwhile)


TRY = SURGEON.flatmap(trying)
PLAN = step("plan", SURGEON, MEANWHILE)
ERASED = st.tuples(st.integers(4, 7), ERASE_DEMO)  # while distances are measured
ATLAS = step("atlas", SUTURE, st.one_of(MEANWHILE, ERASED, ERASED))
STEPS = (
    *ELSEWHERE,
    TRAIN,
    TRAIN,
    TRAIN,  # more often, because all else needs a learnt policy
    step("ask_training", SURGEON, SUTURE, DEMOS, SEED, FLAG, ANY_OUTCOME),
    step("retrain", st.none() | SURGEON, st.booleans(), FLAG, MEANWHILE),
    step("ask_retraining", st.none() | SURGEON, st.booleans(), FLAG),
    step("again", INDEX),
    step("again", INDEX),
    step("work", INDEX, MEANWHILE),
    PLAN,
    ATLAS,
    ATLAS,
    ADD_DEMO,
    ADD_DEMO,
    step("add_recording", FILE, st.none() | SURGEON),
    step("delete_recording", FILE),
    step("export", INDEX),
    step("make_key", st.none() | SURGEON, st.none() | st.integers(0, 1)),
    step("revoke", INDEX),
    step("use_key", INDEX),
    step("write_list"),
    step("restore", INDEX),
    TRY,
    TRY,
    step("copy"),
    step("put_back", INDEX, st.booleans()),
    step("other_key"),
    step("second_machine"),
    step("verify"),
)


class Installation(Compared):
    """The state machine of all user actions; two surgeons have a demonstration each at the beginning."""

    backend: ClassVar[str]
    steps: ClassVar[list[Step]] = []  # of the last installation

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="installation-", dir=backends.migrated_file().parent))
        self.model = Model(FIRST_DAY)
        Clock.day = FIRST_DAY
        self.backups: list[tuple[Path, Model]] = []
        self.copies: list[tuple[str, Model, str]] = []  # their URLs, and the newest checkpoints in them
        self.digests: dict[tuple[str, Style], str] = {}  # of demonstrations, by recording and style
        self.styles: set[Style] = set()  # styles that were ever learnt
        type(self).steps = []
        self.url, self.admin = settled(self.backend, self.folder)
        self._open()
        for surgeon in SURGEONS[:2]:
            self._agree(surgeon)
            self._add_demo(surgeon, SUTURES[0], 0)

    def teardown(self) -> None:
        self._close()
        for url, _, _ in self.copies:
            backends.drop(url)
        shutil.rmtree(self.folder)

    def _open(self, **settings: Any) -> None:
        self.service = Service(self.url, key_requests_per_s=1e6, **settings)
        self.service.http.__enter__()
        self.service.http.headers["X-API-Key"] = self.admin
        self.worker = copy(self.service.database)  # with the same connections, so that its commits are visible at once
        self.worker.__class__ = Interruptible

    def _stop(self) -> None:
        self.service.http.__exit__(None, None, None)

    def _close(self) -> None:
        self._stop()
        backends.drop(self.url)

    @rule(step=st.one_of(*STEPS))  # one rule: with several, hypothesis would leave some out of each run
    def take(self, step: Step) -> None:
        self.steps.append(step)
        self._do(step)

    def _do(self, step: Step) -> None:
        if step[0] not in self.without:
            getattr(self, f"_{step[0]}")(*step[1:])

    @classmethod
    def play(cls, *steps: Step) -> None:
        """Take some steps from the beginning."""
        machine = cls()
        try:
            machine.check()
            for one in steps:
                machine.take(one)
                machine.check()
        finally:
            machine.teardown()

    # ---- surgeons, recordings, demonstrations ----

    def _agree(self, surgeon: str, uses: frozenset[str] | None = None, days: int | None = None) -> None:
        until = None if days is None else self.model.today + timedelta(days=days)
        consent = Consent(frozenset(ALL_USES) if uses is None and until else uses, until)
        if surgeon in self.model.erased:
            self.call("PUT", f"/surgeons/{surgeon}", 410, json={"consent": consent.written})
        else:
            self.call("PUT", f"/surgeons/{surgeon}", 200, 201, json={"consent": consent.written})
            self.model.agree(surgeon, consent)

    def _pass_a_day(self) -> None:
        self.model.today += timedelta(days=1)
        Clock.day = self.model.today

    def _add_demo(self, surgeon: str, suture: str, file: int) -> None:
        query = {"surgeon": surgeon, "suture": suture}
        how = {"params": query, "content": FILES[file], "headers": {"Content-Type": CSV}}
        known = self.model.demos.get(self.digests.get((sha256(FILES[file]), (surgeon, suture)), ""))
        if surgeon not in self.model.surgeons:
            self.call("POST", "/demos", self._unknown(surgeon), **how)
        elif known is not None and known.withdrawn:
            self.call("POST", "/demos", 409, **how)
        else:
            said = self.call("POST", "/demos", 201 if known is None else 200, **how)
            demo = Demo(said["sha256"], (said["surgeon"], said["suture"]), said["recording"])
            assert self.digests.setdefault((demo.recording, demo.style), demo.sha256) == demo.sha256
            self.model.add_demo(demo)

    def _add_recording(self, file: int, surgeon: str | None = None) -> None:
        of = {} if surgeon is None else {"surgeon": surgeon}
        how = {"params": of, "content": FILES[file], "headers": {"Content-Type": CSV}}
        if surgeon is not None and surgeon not in self.model.surgeons:
            self.call("POST", "/recordings", self._unknown(surgeon), **how)
        else:
            self.model.add_recording(self.call("POST", "/recordings", 200, 201, **how)["sha256"], surgeon)

    def _delete_recording(self, file: int) -> None:
        recording = sha256(FILES[file])
        if recording not in self.model.recordings:
            self.call("DELETE", f"/recordings/{recording}", 404)
        elif self.model.cut_from(recording):
            self.call("DELETE", f"/recordings/{recording}", 409)
        else:
            self.call("DELETE", f"/recordings/{recording}", 204)
            self.model.delete_recording(recording)

    def _decide(self, state: str, note: str | None = None) -> None:
        """Decide on the proposal of the recording that has one."""
        where, body = f"/recordings/{PROPOSED}/proposals/1", {"state": state, "note": note}
        if PROPOSED not in self.model.recordings:
            self.call("PUT", where, 404, json=body)
        elif self.model.cut_from(PROPOSED):
            self.call("PUT", where, 409, json=body)
        else:
            assert self.call("PUT", where, 200, json=body)["state"] == state
            self.model.decide(PROPOSED, state, note)

    def _withdraw_demo(self, index: int) -> None:
        if (demo := pick(self.model.demos, index)) is not None:
            self.call("DELETE", f"/demos/{demo}", 204)
            self.model.withdraw_demo(demo)

    def _mark(self, index: int, outcome: str) -> None:
        if (demo := pick(self.model.demos, index)) is not None:
            body = {"outcome": outcome, "reason": WHY}
            assert self.call("PUT", f"/demos/{demo}/outcome", 200, json=body)["outcome"] == outcome
            self.model.mark_demo(demo, outcome, WHY)

    def _erase_demo(self, index: int) -> None:
        if (demo := pick(self.model.demos, index)) is not None:
            self.call("DELETE", f"/demos/{demo}?erase=true", 204)
            self.model.erase_demo(demo)

    def _erase_surgeon(self, surgeon: str, doubts: int = 0) -> None:
        if doubts:
            return  # nobody is added again, so all would soon be gone
        if surgeon in self.model.surgeons:
            self.call("DELETE", f"/surgeons/{surgeon}", 204)
            self.model.erase_surgeon(surgeon)
        else:
            self.call("DELETE", f"/surgeons/{surgeon}", self._unknown(surgeon))

    def _export(self, index: int) -> None:
        """Ask for a demonstration's motion as a file, and for a dataset of its whole recording."""
        if (name := pick(self.model.demos, index)) is None or "exports" in self.without:
            return
        demo = self.model.demos[name]
        may = self.model.may_export(demo.recording)
        as_mcap = {"headers": {"Accept": "application/vnd.mcap"}}
        self.call("GET", f"/timelines/demos/{name}", 200 if may else 409, **as_mcap)
        body = {"demos": [name], "whole": True, "outcomes": "any"}
        job = self.call("POST", "/datasets", *((200, 202) if may and not demo.withdrawn else (409,)), json=body)
        if may and not demo.withdrawn:
            self.call("DELETE", f"/jobs/{job['id']}", 200)

    # ---- releases ----

    def _release(self, index: int) -> None:
        if (name := pick(self.model.versions, index)) is None:
            return
        version = self.model.versions[name]
        path = f"/policies/{'/'.join(version.style)}/versions/{version.number}/release"
        if self.model.may_serve(version) and version.releasable:
            assert self.call("POST", path, 200)["sha256"] == name
            self.model.release(version)
        else:
            self.call("POST", path, 409)

    def _withdraw(self, index: int) -> None:
        if (style := pick(sorted({one.style for one in self.model.versions.values()}), index)) is not None:
            there = self.model.standing(style)
            self.call("DELETE", f"/policies/{'/'.join(style)}/release", 204 if there else 404)
            self.model.withdraw(style)

    # ---- requests for jobs ----

    def _train(
        self,
        surgeon: str,
        suture: str,
        which: str,
        seed: int,
        release: bool,
        meanwhile: Meanwhile = None,
        of_any: bool = False,
    ) -> None:
        """Request a training and wait for its end, as `skills train` does."""
        if (job := self._ask_training(surgeon, suture, which, seed, release, of_any)) is not None:
            self._wait(job, meanwhile)

    def _ask_training(
        self, surgeon: str, suture: str, which: str, seed: int, release: bool, of_any: bool = False
    ) -> str | None:
        body: dict[str, Any] = {"surgeon": surgeon, "suture": suture, "seed": seed, "release": release}
        active = [one.sha256 for one in self.model.active((surgeon, suture))]
        taken = [one for one in active if of_any or not self.model.demos[one].failed]
        chosen = {"newest": taken[-1:], "oldest": active[:1], "all": active}[which]
        if which != "newest":
            body["demos"] = chosen or None
        if of_any:
            body["outcomes"] = "any"
        if surgeon not in self.model.surgeons:
            self.call("POST", "/trainings", self._unknown(surgeon), json=body)
            return None
        if not chosen or not self.model.may_learn(set(chosen), of_any):
            self.call("POST", "/trainings", 409, json=body)
            return None
        job = self.call("POST", "/trainings", 200, 202, json=body)
        assert job["request"]["demos"] == chosen
        return self._asked(job, Job(job["id"], surgeon, release, frozenset(chosen), job["state"], of_any=of_any))

    def _try(self, surgeon: str, suture: str, file: int, meanwhile: Meanwhile = None) -> None:
        """Request a try of a recording that leaves the later questions open, and wait for its end."""
        recording = sha256(FILES[file])
        body = {"recording": recording, "surgeon": surgeon, "suture": suture, "cell_mm": CELL_MM, "hysteresis": 0.0}
        if surgeon not in self.model.surgeons:
            self.call("POST", "/tries", self._unknown(surgeon), json=body)
        elif not self.model.may(surgeon, "training"):
            self.call("POST", "/tries", 409, json=body)
        elif recording not in self.model.recordings:
            self.call("POST", "/tries", 404, json=body)
        else:
            said = self.call("POST", "/tries", 200, 202, json=body)
            job = Job(
                said["id"], surgeon, False, frozenset(), said["state"], recording=recording, style=(surgeon, suture)
            )
            self._wait(self._asked(said, job), meanwhile)

    def _retrain(self, surgeon: str | None, only_stale: bool, release: bool, meanwhile: Meanwhile = None) -> None:
        """Request a batch and wait for its end, as `skills retrain` does."""
        if (job := self._ask_retraining(surgeon, only_stale, release)) is not None:
            self._wait(job, meanwhile)

    def _again(self, index: int) -> None:
        """Request a training or a batch that was requested before, the newest first, as where an answer was lost."""
        requests = [one for one in reversed(self.steps) if one[0] in REQUESTS]
        if (request := pick(requests, index)) is not None:
            self._do(request)

    def _ask_retraining(self, surgeon: str | None, only_stale: bool, release: bool) -> str | None:
        body = {"surgeon": surgeon, "only_stale": only_stale, "release": release}
        if surgeon is not None and surgeon not in self.model.surgeons:
            self.call("POST", "/retrainings", self._unknown(surgeon), json=body)
            return None
        taken = [one for one in self.model.demos.values() if not one.withdrawn and not one.failed]
        active = [one for one in taken if surgeon in (None, one.style[0])]
        if not active:
            self.call("POST", "/retrainings", 409, json=body)
            return None
        job = self.call("POST", "/retrainings", 200, 202, json=body)
        demos = frozenset(one.sha256 for one in active)
        return self._asked(job, Job(job["id"], surgeon, release, demos, job["state"], batch=True))

    def _asked(self, said: dict[str, Any], job: Job) -> str:
        """Record a requested job; a job that has already ended reports the state of now."""
        known = self.model.jobs.setdefault(job.id, job)
        assert (known.release, known.batch) == (job.release, job.batch)
        assert said["state"] in (*ACTIVE, "succeeded"), said
        if said["state"] == "succeeded" and job.release and not job.batch:
            version = self.model.versions[said["result"]["sha256"]]
            self.model.release(version)  # also if another one was released since, or it was withdrawn
            assert said["result"]["released"], said["result"]
        elif said["state"] == "succeeded" and job.release:
            for one in self._styles(job.id):
                how, served = one["comparison"], self.model.served((one["surgeon"], one["suture"]))
                if one["state"] == "done" and one["sha256"] is not None:
                    assert how["now_released"] == (served is not None and served.sha256 == one["sha256"]), how
                    assert how["now_released"] or how["not_released_because"], "not released, and no reason"
        return job.id

    def _styles(self, batch: str) -> list[dict[str, Any]]:
        styles: list[dict[str, Any]] = self.call("GET", f"/retrainings/{batch}?limit=200", 200)["items"]
        return styles

    def _cancel(self, index: int) -> None:
        if (name := pick(self.model.jobs, index)) is None:
            return
        job = self.model.jobs[name]
        self.call("DELETE", f"/jobs/{name}", 200 if job.state in (*ACTIVE, "cancelled") else 409)
        if job.state in ACTIVE:
            job.state = "cancelled"

    # ---- work on jobs ---- ----

    def _work(self, index: int, meanwhile: Meanwhile = None) -> None:
        """Carry out one waiting job, or a part of a batch."""
        if (one := pick(self._waiting(), index)) is not None:
            self._perform(*one, meanwhile)

    def _wait(self, job: str, meanwhile: Meanwhile) -> None:
        """Carry out a job, or all parts of a batch."""
        while mine := [one for one in self._waiting() if one[0] == job]:
            self._perform(*mine[0], meanwhile)
            meanwhile = None

    def _waiting(self) -> list[tuple[str, int, int]]:
        """List the work for a worker: the job that it belongs to, and its row and attempt."""
        active = JobRow.state.in_(ACTIVE), JobRow.kind != BATCH
        with self.service.database.reading() as session:
            rows = session.scalars(select(JobRow).where(*active).order_by(JobRow.row)).all()
            of = [row if row.kind != PART else session.get(JobRow, row.request["retraining"]) for row in rows]
        return [("" if job is None else job.id, row.row, row.attempt) for job, row in zip(of, rows, strict=True)]

    def _perform(self, job: str, row: int, attempt: int, meanwhile: Meanwhile) -> None:
        self._doubt()
        with self._meanwhile(meanwhile, job):
            work = Work(self.worker, Settings(database_url=self.url), perform_job)
            assert work.try_once(row, attempt, 0), "the job failed inside the service"
        self._take_in(job)

    @contextmanager
    def _meanwhile(self, meanwhile: Meanwhile, job: str = "") -> Iterator[None]:
        """Run another action before a transaction of the worker."""
        left, other = meanwhile or (0, ())

        def pause() -> None:
            nonlocal left
            left -= 1
            if left == 0:
                self._take_in(job)
                self._do(other)
                self._doubt()
                self.check()

        Interruptible.pause = staticmethod(pause)
        try:
            yield
        finally:
            Interruptible.pause = staticmethod(lambda: None)

    def _doubt(self) -> None:
        """Record the present obstacles of jobs."""
        for job in self.model.jobs.values():
            if job.recording is not None and not self.model.may_try(job):
                job.doubt.add(job.recording)
            job.doubt |= {one for one in job.demos if not self.model.may_learn({one}, job.of_any)}

    def _take_in(self, name: str) -> None:
        """Record the result of a job, and check it."""
        if (job := self.model.jobs.get(name)) is None:
            return
        said = self.call("GET", f"/jobs/{name}", 200)
        if job.batch:
            self._take_in_styles(job)
        elif job.recording is not None:
            self._take_in_try(job, said)
        elif said["state"] == "succeeded" and job.state != "succeeded":
            made, style = said["result"], (said["request"]["surgeon"], said["request"]["suture"])
            version = self._learnt(made["sha256"], style)
            assert (version.number, version.demos, version.of_any) == (made["policy_version"], job.demos, job.of_any)
            assert made["was_released"] == (job.release and version.releasable), made
            self._released(job, version, made["was_released"], made["not_released_because"])
        elif said["state"] == "failed" and job.state != "failed":
            assert job.doubt, f"nothing stood in its way: {said['error']}"
            assert said["error"]
        job.state = said["state"]

    def _take_in_try(self, job: Job, said: dict[str, Any]) -> None:
        """Record the demonstration and the version that a try has stored while it stood."""
        if job.state in ACTIVE:
            with self.service.database.reading() as session:
                cut = select(Demonstration).where(Demonstration.suture == job.style[1])
                demos = [(one.sha256, one.surgeon.slug, one.recording.sha256) for one in session.scalars(cut)]
                learnt = session.scalars(select(PolicyVersion)).all()
                versions = [(one.sha256, [of.sha256 for of in one.demonstrations]) for one in learnt]
            made = {name for name, *of in demos if of == [job.surgeon, job.recording]}
            for name in made - {*self.model.demos}:
                assert self.model.may(job.style[0], "training"), "cut, and consent forbids it"
                assert self.digests.setdefault((job.recording or "", job.style), name) == name
                self.model.add_demo(Demo(name, job.style, job.recording or ""))
            for name, of in versions:
                if name not in self.model.versions and {*of} <= made:
                    self._learnt(name, job.style)
        if said["state"] == "succeeded" and job.state != "succeeded":
            ids = {one["name"]: one["id"] for one in said["result"]["steps"]}
            assert ids["cut"] in self.model.demos and ids["train"] in self.model.versions
        elif said["state"] == "failed" and job.state != "failed":
            assert job.doubt and said["error"], f"nothing stood in its way: {said['error']}"

    def _take_in_styles(self, job: Job) -> None:
        for one in self._styles(job.id):
            if one["state"] == "queued" or one["demo"] in job.ended:
                continue
            job.ended.add(one["demo"])
            if one["state"] == "done":
                how, style = one["comparison"], (one["surgeon"], one["suture"])
                before = self.model.standing(style)
                version = self._learnt(one["sha256"], style)
                assert one["demo"] in version.demos or not self.model.may_learn({one["demo"]})
                if job.release and not before:
                    assert how["was_released"] == version.releasable, how
                self._released(job, version, how["was_released"], how["not_released_because"])
            elif one["state"] == "failed":
                assert job.doubt, f"nothing stood in its way: {one['reason']}"
                assert one["reason"]

    def _learnt(self, name: str, style: Style) -> Version:
        """Record a version that a job reports as stored."""
        said = self.call("GET", f"/policy-versions/{name}", 200)
        assert (said["surgeon"], said["suture"]) == style
        releasable = not said["grid_certificate"]["refused_because"]
        of_any = said.get("outcomes") is not None
        version = Version(name, style, said["version"], frozenset(said["demos"]), releasable, of_any)
        if name not in self.model.versions:
            used = self.model.numbers.get(style, 0)
            assert version.number > used or "numbers" in self.without, "the number of a version is used again"
            self.model.add_version(version)
        assert self.model.versions[name] == version
        return version

    def _released(self, job: Job, version: Version, released: bool, because: str | None) -> None:
        """Record a job's report that it made a release, or did not."""
        if released:
            assert job.release
            assert self.model.may_serve(version), "released, and consent, a withdrawal or a mark forbids it"
            self.model.release(version)
        elif job.release:
            assert because, "not released, and no reason"

    # ---- plans and the atlas ----

    def _plan(self, surgeon: str, meanwhile: Meanwhile = None) -> None:
        served = self.model.served((surgeon, SUTURES[0])) if surgeon in self.model.surgeons else None
        plan, refused = None, None
        with self._meanwhile(meanwhile):
            try:
                plan = cases.add_plan(self.worker, surgeon)
            except SkillsError as error:
                refused = error
        if plan is not None:
            self.model.add_plan(plan.sha256, plan.policy.sha256)
        else:
            assert served is None or not self.model.may_serve(served), f"nothing stood in its way: {refused}"

    def _atlas(self, suture: str, meanwhile: Meanwhile = None) -> None:
        with self._meanwhile(meanwhile), suppress(NotFound):
            atlas_of(self.worker, suture)
        self.check()
        members = self.model.in_atlas(suture)
        said = self.call("GET", f"/styles/{suture}/atlas", 200 if members else 404)
        assert {one["id"] for one in said["demos"]} == members if members else True

    # ---- keys ----

    def _make_key(self, surgeon: str | None, days: int | None) -> None:
        last = None if days is None else self.model.today + timedelta(days=days)
        end = None if last is None else f"{last + timedelta(days=1)}T00:00:00Z"
        of = None if surgeon is None else [surgeon]
        body = {"owner": "anna", "role": "reader", "expires_at": end, "surgeons": of}
        if surgeon is not None and surgeon not in self.model.surgeons:
            self.call("POST", "/keys", self._unknown(surgeon), json=body)
        else:
            made = self.call("POST", "/keys", 201, json=body)
            self.model.keys[made["key"]] = Key(made["secret"], surgeon, last)

    def _revoke(self, index: int) -> None:
        if (name := pick(self.model.keys, index)) is not None:
            self.call("DELETE", f"/keys/{name}", 200)
            self.model.revoke(name)

    def _use_key(self, index: int) -> None:
        if (name := pick(self.model.keys, index)) is None:
            return
        key = self.model.keys[name]
        with_it = {"headers": {"X-API-Key": key.secret}}
        if not self.model.lets_in(key):
            self.call("GET", "/surgeons", 401, **with_it)
            return
        seen = {one["surgeon"] for one in self.call("GET", "/surgeons", 200, **with_it)["items"]}
        assert seen == {one for one in self.model.surgeons if key.surgeon in (None, one)}
        for surgeon in self.model.erased if "numbers" not in self.without else ():
            self.call("GET", f"/surgeons/{surgeon}", 410 if key.surgeon is None else 404, **with_it)

    # ---- backups ----

    def _back_up(self) -> None:
        if len(self.backups) < MOST_BACKUPS:
            file = self.folder / f"{len(self.backups)}.zip"
            back_up(self.service.database, file)
            self.backups.append((file, self.model.snapshot()))

    def _write_list(self) -> None:
        keep_erasures(self.service.database, self.folder / "list.json")

    def _restore(self, index: int) -> None:
        """Write the list, and continue with a backup in place of the database."""
        if (chosen := pick(self.backups, index)) is None:
            return
        file, backup = chosen
        self._write_list()
        self._close()
        self.url = backends.blank(self.backend, self.folder)
        database = Database(self.url)
        restore(database, file, read_erasures(str(self.folder / "list.json")))
        database.close()
        self._open()
        self.model = self.model.restored(backup)

    # ---- rollbacks, keys and machines ----

    def _copy(self) -> None:
        """Copy the whole database, as a snapshot of its disk would."""
        if len(self.copies) < MOST_COPIES:
            head = self._signed()
            self._stop()
            self.copies.append((copy_away(self.url), self.model.snapshot(), head))
            self._open()

    def _put_back(self, index: int, accepted: bool) -> None:
        """Put an older copy in place of the database; then accept it, or put the right one back."""
        if (chosen := pick(self.copies, index)) is None:
            return
        copy, model, head = chosen
        self._write_list()
        same = self._signed() == head
        self._stop()
        right = copy_away(self.url)
        put_back(copy, self.url)
        self._open()
        if not same:  # otherwise nothing was logged since, so it is no older one
            self._serves_nothing("saved last")
            self._stop()
            if accepted:
                with closing(Database(self.url)) as database:
                    accept_rollback(database, read_erasures(str(self.folder / "list.json")))
                self.model = self.model.restored(model)
            else:
                put_back(right, self.url)
            self._open()
        backends.drop(right)

    def _serves_nothing(self, because: str) -> None:
        """Check that nothing is served and nothing written, and that the answers say why."""
        calls = [("PUT", "/surgeons/kestrel"), ("GET", "/readyz")]
        for method, path in calls + [("GET", f"/policies/{'/'.join(style)}") for style in sorted(self.styles)]:
            said = self.call(method, path, 503, json={"consent": None} if method == "PUT" else None)
            assert because in said["detail"], said

    def _signed(self) -> str:
        """Sign all that is not signed yet, as a worker does, and return the newest checkpoint."""
        sign_history(self.service.database)
        with self.service.database.reading() as session:
            return newest_checkpoint(session.connection()) or ""

    def _other_key(self) -> None:
        """Start with another signing key, and then with the right one."""
        other = self.folder / "other.key"
        other.write_text(str(SigningKey(secrets.token_bytes(32))))
        self._stop()
        self._open(signing_key=other)
        self._serves_nothing("another key")
        self._stop()
        self._open()

    def _second_machine(self) -> None:
        """Let another machine learn every version again and export every plan, judged here."""
        with self.service.database.reading() as session:
            unplayed = session.scalars(select(Plan).where(Plan.row.not_in(select(StoredPlayback.plan_row)))).all()
        for plan in unplayed:
            judged(self.service.database, plan)
        here, there = seen(self.url), SecondMachine.seen(self.url)
        assert not any(here["differing"].values()), here["differing"]
        assert there == here, f"another machine: {there}, and this one: {here}"

    def _verify(self) -> None:
        with self.service.database.reading() as session:
            assert [*verify_history(session.connection(), self.service.database.history, None, Verified())] == []


def pick(some: Any, index: int) -> Any:
    """Choose an item by index modulo their number, or None if there is none."""
    return list(some)[index % len(some)] if some else None
