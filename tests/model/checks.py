"""An installation compared with `tests.model.invariant`: the objects that it serves, and the rows that it stores."""

from collections import Counter
from collections.abc import Set
from functools import cache
from typing import Any, ClassVar

import numpy as np
from hypothesis.stateful import RuleBasedStateMachine, invariant
from sqlalchemy import LargeBinary, select

from skills.comparison.distances import distances_of, shape_of
from skills.db import Base
from skills.db.models import Demonstration, MeasuredShape
from skills.db.packed import Packed
from skills.demonstration.demonstration import cut_demo
from skills.demonstration.segments import Segment, propose_by_arm
from skills.formats import Recording, read_recording
from skills.library.operation.jobs import PART
from skills.packing import sha256
from tests.api.service import Service
from tests.library import cases
from tests.model.invariant import Model, Style
from tests.model.replaced import ADMIN

ACTIVE = ("queued", "running")


def _proposed() -> bytes:
    """Return a slow table whose jaw closes after the first sample and opens at the last one: it has one proposal."""
    named, *lines = cases.table(cases.points_mm((0.0, 7.5, 0.0), samples=4), rate_hz=5.0).decode().splitlines()
    jaw = [1.0, *[0.0] * (len(lines) - 2), 1.0]
    return "\n".join(
        [f"{named},jaw_rad", *(f"{line},{rad}" for line, rad in zip(lines, jaw, strict=True)), ""]
    ).encode()


FILES = [*(cases.table(cases.points_mm((0.0, 2.5 * shift, 0.0), samples=4)) for shift in range(3)), _proposed()]
NAMES = {sha256(data): data for data in FILES}
PROPOSED = sha256(FILES[-1])  # the recording that has a proposal


class Compared(RuleBasedStateMachine):
    """The installation that the service serves, compared with the model after every step."""

    model: Model
    service: Service
    without: ClassVar[Set[str]] = frozenset()  # steps and checks that are left out, to look past a known defect
    styles: set[Style]  # styles that were ever learnt

    def call(self, method: str, path: str, *expected: int, **how: Any) -> Any:
        """Call the service, check the status and conformance of the response, and return its content."""
        answer = self.service.http.request(method, path, **how)
        said = f"{method} {path}: {answer.status_code}, not {expected}: {answer.text[:300]}"
        assert answer.status_code in expected, said
        return answer.json() if answer.content and "json" in answer.headers["content-type"] else None

    def _unknown(self, surgeon: str) -> int:
        return 410 if surgeon in self.model.erased else 404

    @invariant()
    def check(self) -> None:
        """Compare the served and stored objects with the model."""
        self._check_served()
        self._check_answers()
        stored = self._rows()
        self._check_library(stored)
        self._check_proposals(stored)
        self._check_books(stored)
        self._check_distances()
        self._check_exports()
        for table, rows in stored.items():
            said = str(rows)
            assert not any(surgeon in said for surgeon in self.model.erased), f"'{table}' names an erased surgeon"

    def _check_served(self) -> None:
        model = self.model
        self.styles |= {one.style for one in model.versions.values()}
        due = {style: model.served(style) for style in self.styles}
        listed = self.call("GET", "/policies", 200)["items"]
        assert {(one["surgeon"], one["suture"]): one["sha256"] for one in listed} == {
            style: version.sha256 for style, version in due.items() if version is not None
        }, "what is listed as served"
        for style, version in due.items():
            said = self.call("GET", f"/policies/{'/'.join(style)}", 200 if version else self._unknown(style[0]))
            assert version is None or (said["sha256"], said["version"]) == (version.sha256, version.number)
            assert version is None or version.of_any or not any(model.demos[one].failed for one in version.demos)

    def _check_answers(self) -> None:
        """Check that every training reports whether its version is the served one."""
        for one in self.call("GET", "/jobs?kind=training&state=succeeded&limit=200", 200)["items"]:
            served = self.model.served((one["request"]["surgeon"], one["request"]["suture"]))
            made = one["result"]
            assert made["released"] == (served is not None and served.sha256 == made["sha256"]), made

    def _check_library(self, stored: dict[str, Any]) -> None:
        model = self.model
        assert {one.slug: one.consent and one.consent.model_dump(mode="json") for one in stored["surgeons"]} == {
            surgeon: consent.written for surgeon, consent in model.surgeons.items()
        }
        assert {one.sha256 for one in stored["recordings"]} == set(model.recordings)
        assert {one.recording for one in stored["recording_chunks"]} == {one.row for one in stored["recordings"]}
        assert {one.sha256: one.withdrawn_at is not None for one in stored["demonstrations"]} == {
            one.sha256: one.withdrawn for one in model.demos.values()
        }
        marks = {one.demonstration_row: one.outcome for one in stored["demonstration_outcomes"]}  # the newest of each
        assert {one.sha256: marks.get(one.row) for one in stored["demonstrations"]} == {
            one.sha256: one.mark and one.mark[0] for one in model.demos.values()
        }
        slugs = {one.row: one.slug for one in stored["surgeons"]}
        assert {(one.sha256, slugs[one.surgeon_row], one.suture, one.version) for one in stored["policy_versions"]} == {
            (one.sha256, *one.style, one.number) for one in model.versions.values()
        }
        versions = {one.row: one.sha256 for one in stored["policy_versions"]}
        assert Counter(
            (versions[one.policy_row], one.withdrawn_at is not None) for one in stored["releases"]
        ) == Counter((one.version.sha256, one.withdrawn) for one in model.releases)

    def _check_proposals(self, stored: dict[str, Any]) -> None:
        names = {one.row: one.sha256 for one in stored["recordings"]}
        newest = {names[one.recording_row]: (one.state, one.note) for one in stored["proposal_marks"]}
        assert newest == self.model.decided
        listed = {one["recording"]: one["state"] for one in self.call("GET", "/proposals", 200)["items"]}
        due = {PROPOSED: self.model.proposal(PROPOSED)} if PROPOSED in self.model.recordings else {}
        assert listed == due, "what is listed as proposed"

    def _check_books(self, stored: dict[str, Any]) -> None:
        model = self.model
        assert {one.id: one.revoked_at is not None for one in stored["keys"] if one.owner != ADMIN} == {
            name: key.revoked for name, key in model.keys.items()
        }
        jobs = {one.id: one.state for one in stored["jobs"] if one.kind != PART}
        assert {name for name, state in jobs.items() if state in ACTIVE} == {
            one.id for one in model.jobs.values() if one.state in ACTIVE
        }

    def _check_exports(self) -> None:
        """Check that the bytes of each recording are passed on or refused."""
        for demo in self.model.demos.values() if "exports" not in self.without else ():
            may = self.model.may_export(demo.recording)
            self.call("GET", f"/demos/{demo.sha256}/recording", 200 if may else 409)

    def _rows(self) -> dict[str, Any]:
        """Read all tables, without packed values."""
        with self.service.database.engine.connect() as connection:
            return {name: connection.execute(query).all() for name, query in _plain_columns().items()}

    def _check_distances(self) -> None:
        """Check that each cached distance of the atlas is between two stored demonstrations, and correct."""
        with self.service.database.reading() as session:
            files = {one.row: one.recording.sha256 for one in session.scalars(select(Demonstration))}
            kept = session.execute(select(MeasuredShape.demonstration_row, MeasuredShape.measured)).all()
        for row, measured in kept:
            assert row in files
            for other, mm in zip(measured.others.tolist(), measured.apart_mm.tolist(), strict=True):
                assert other in files, "a distance from an erased demonstration is kept"
                assert np.isclose(mm, distance_mm(files[row], files[other])), "a distance is another demonstration's"


@cache
def distance_mm(one: str, other: str) -> float:
    """Measure the distance of two recordings anew."""
    shapes = []
    for recording in (read_recording(cases.upload(NAMES[name]).file) for name in (one, other)):
        part = {"start_s": segment.start_s, "end_s": segment.end_s} if (segment := _segment(recording)) else {}
        shapes.append(shape_of(cut_demo(recording, **part)))
    return float(distances_of(np.array(shapes), np.array([(0, 1)]))[0])


def _segment(recording: Recording) -> Segment | None:
    """Return the only proposal of a recording, None if it has none."""
    return next(iter(propose_by_arm(recording)), None)


@cache
def _plain_columns() -> dict[str, Any]:
    packed = (LargeBinary, Packed)
    tables = Base.metadata.tables.items()
    return {
        name: select(*(c for c in table.c if not isinstance(c.type, packed))).order_by(*table.primary_key)
        for name, table in tables
    }
