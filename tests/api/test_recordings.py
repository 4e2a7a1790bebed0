"""`GET /recordings`: a page of all recordings that the caller may see."""

from dataclasses import replace

import pytest
from sqlalchemy import select

from skills.db.models import StoredRecording
from skills.formats import write_mcap
from skills.library.recordings.recordings import summarise_recording
from tests.api.service import CSV, KESTREL, Service
from tests.demonstration import sessions
from tests.library import cases


def test_recordings_are_listed_the_newest_first_page_by_page(here: Service):
    assert here.http.get("/recordings").json() == {"items": [], "next": None}
    sent = []
    for shift in (0.0, 2.5, 5.0):
        how = {"content": cases.hand_off((shift, 0.0, 0.0)), "headers": {"Content-Type": CSV}}
        sent.append(here.http.post("/recordings", **how).json()["id"])
    first = here.http.get("/recordings", params={"limit": 2}).json()
    second = here.http.get("/recordings", params={"limit": 2, "cursor": first["next"]}).json()
    assert [one["id"] for one in first["items"] + second["items"]] == sent[::-1]
    assert second["next"] is None


def test_a_line_has_the_counts_of_what_is_in_the_recording(here: Service):
    value, truths = sessions.session(sessions.Kind(seed=1, passes=2))
    stored = here.client.add_recording(write_mcap(value))
    mine = next(one for one in stored["segments"] if one["arm"] == sessions.A)
    part = {"arm": sessions.A, "start_s": mine["start_s"], "end_s": mine["end_s"]}
    demo = here.client.cut_demo(stored["id"], **KESTREL, **part)
    (line,) = here.http.get("/recordings").json()["items"]
    assert (line["arms"], line["demos"], line["format"]) == (["PSM1", "PSM2"], 1, "mcap")
    assert line["segments"] == len(stored["segments"]) > len(truths)
    assert line["duration_s"] == pytest.approx(value.duration_s)
    assert here.http.delete(f"/demos/{demo['id']}").is_success
    assert here.http.get("/recordings").json()["items"][0]["demos"] == 0


def test_a_list_counts_every_proposal_of_a_recording(here: Service) -> None:
    """Before, it counted those that the description holds, at most 200, and contradicted the recording's own page."""
    here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    with here.database.reading() as session:
        row = session.scalars(select(StoredRecording)).one()
        session.expunge(row)
    row.about = row.about.model_copy(update={"counts": replace(row.about.counts, segments=321)})
    assert summarise_recording(row, demos=1).segments == 321
