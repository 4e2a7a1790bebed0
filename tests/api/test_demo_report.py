"""The report of a demonstration, for programs and for people; and PSM_M's pose, which plans take from it."""

import base64
import hashlib
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from skills.api.pages.filters import share
from skills.demonstration.recording import Motion, Recording
from skills.formats import read_recording, write_mcap
from skills.kinematics import matrix_of, quaternion_of
from skills.seeds.recordings import sample_recordings
from tests.api.html import Html
from tests.api.service import CSV, GOAL_MM, KESTREL, Service, assert_problem
from tests.demonstration import sessions
from tests.library import cases

PAGE = {"Accept": "text/html"}
BASE_MM, BASE_XYZW = [160.0, 20.0, 20.0], [0.0, 0.0, 0.3826834324, 0.9238795325]  # PSM1's in PSM2's, invented
NUMBERS = (
    "duration_s", "samples", "rate_hz", "longest_gap_s", "duplicate_stamps", "path_length_mm", "extent_mm",
    "speed_median_mm_s", "speed_peak_mm_s", "jerk_rms_mm_s3", "log_dimensionless_jerk", "spectral_arc_length",
    "clutch_presses", "clutched_s", "undriven_s", "idle_share", "a1_s", "a1_orientation_change_rad",
    "a1_turn_negligible", "orientation_change_rad", "path_states", "revisits", "returns", "bridged_cells",
    "discretisation_rmse_mm", "discretisation_rmse_3d_mm", "outside_paper_grid_share", "advised_hysteresis", "grid",
    "partner", "advice", "backward_stamps", "equal_samples",
)  # fmt: skip


@pytest.fixture
def plover(here: Service) -> dict:
    """Store a hesitant demonstration with two presses of the clutch and a tremor."""
    sample = next(s for s in sample_recordings() if s.surgeon == "plover")
    start_s, end_s = sample.segments[0]
    return here.client.add_demo(sample.data, **KESTREL, start_s=start_s, end_s=end_s)


def test_a_report_says_all_that_is_measured(here: Service, plover: dict):
    answer = here.http.get(f"/demos/{plover['id']}/report")
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["vary"] == "Accept"
    assert answer.json() == plover, "the report that came with it, measured again"
    assert set(NUMBERS) == set(plover["report"])
    report = plover["report"]
    assert (report["clutch_presses"], report["a1_turn_negligible"]) == (2, True)
    assert report["clutched_s"] == report["undriven_s"] == pytest.approx(2.4, abs=0.01)
    said = " ".join(report["advice"])
    for words in ("clutched twice", "starts and stops often", "Request hysteresis 0.25"):
        assert words in said


def test_a_report_is_a_page_for_people(here: Service, plover: dict):
    answer = here.http.get(f"/demos/{plover['id']}/report", headers=PAGE)
    assert answer.headers["content-type"].startswith("text/html")
    page = Html(answer.text)
    assert {"h1", "svg", "polyline", "rect", "table"} <= set(page.names)
    assert page.names.count("svg") >= 4, "three views and the speed"
    for words in (*plover["report"]["advice"], "Path length", "Smoothness", "Turn in A1", "Self-crossings", "Clutch"):
        assert words in page.text
    assert f"{plover['report']['path_length_mm']:.1f} mm" in page.text
    assert share(plover["report"]["idle_share"], 0) in page.text and "%%" not in page.text


def test_a_page_runs_nothing_and_fetches_nothing(here: Service, plover: dict):
    answer = here.http.get(f"/demos/{plover['id']}/report", headers=PAGE)
    page = Html(answer.text)
    assert not {"script", "img", "link", "iframe", "object", "a", "form"} & set(page.names)
    assert not [name for name, _ in page.attributes if name in ("href", "src", "style") or name.startswith("on")]
    style = re.search("<style>(.*?)</style>", answer.text, re.DOTALL)[1]
    allowed = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    policy = answer.headers["content-security-policy"]
    assert policy == f"default-src 'none'; style-src 'sha256-{allowed}'; frame-ancestors 'none'"
    assert here.http.get(f"/demos/{plover['id']}/report").headers["content-security-policy"].startswith("default-src")


def test_the_page_states_the_outcome_and_what_it_means(here: Service, plover: dict):
    def said() -> str:
        return " ".join(Html(here.http.get(f"/demos/{plover['id']}/report", headers=PAGE).text).text.split())

    assert "Outcome: not known." in said()
    here.client.mark_demo(plover["id"], "success")
    assert "Outcome: success." in said()
    here.client.mark_demo(plover["id"], "recovery", reason="It <b>slipped</b>, and was caught.")
    assert "The hand-off was a recovery: It <b>slipped</b>, and was caught. Nothing is learnt from it" in said()


def test_what_a_recording_calls_itself_is_no_mark_up(here: Service):
    """A table's frame may be any word of its pattern; an MCAP file's topic may be any text."""
    value, _ = sessions.session(sessions.Kind(seed=5, passes=1, both_arms=False))
    motion = value.motions[0]
    nasty = f"/{motion.arm}/<script>alert(1)</script>&\"'/measured_cp"
    data = write_mcap(_renamed(value, motion, nasty))
    demo = here.client.add_demo(data, **KESTREL)
    text = here.http.get(f"/demos/{demo['id']}/report", headers=PAGE).text
    assert demo["topic"] == nasty
    assert "<script" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;&amp;" in text


def _renamed(value, motion, topic):
    return replace(value, motions=(replace(motion, topic=topic),), jaws=(), clutch=None)


@pytest.mark.parametrize(
    ("accept", "kind"),
    [
        ("*/*", "json"),
        ("application/json", "json"),
        ("text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8", "html"),
        ("application/json, text/html", "json"),
    ],
)
def test_the_first_that_a_client_names_is_given(here: Service, plover: dict, accept: str, kind: str):
    answer = here.http.get(f"/demos/{plover['id']}/report", headers={"Accept": accept})
    assert kind in answer.headers["content-type"]


def test_a_report_in_another_form_is_refused(here: Service, plover: dict):
    assert_problem(here.http.get(f"/demos/{plover['id']}/report", headers={"Accept": "image/png"}), 415)
    assert_problem(here.http.get(f"/demos/{'0' * 64}/report"), 404, "not-found")


def test_a_good_demonstration_is_told_so(here: Service):
    demo = here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    text = here.http.get(f"/demos/{demo['id']}/report", headers=PAGE).text
    assert "wrist was not recorded" in text
    assert "not recorded" in text, "a turn that is not known"


def test_a_report_that_was_changed_in_the_database_is_measured_again(here: Service):
    demo = here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    other = demo["report"] | {"samples": 1}
    here.tamper("UPDATE demonstrations SET report = :other", other=json.dumps(other | {"segment": demo["segment"]}))
    assert here.client.demo(demo["id"])["report"] == other, "as it was stored"
    assert here.http.get(f"/demos/{demo['id']}/report").json()["report"] == demo["report"]


def test_the_clutched_samples_make_another_demonstration_than_with_them(here: Service, plover: dict):
    """A demonstration of the same segment that was stored with those samples keeps its id.

    It is not returned for this one.
    """
    path = here.client.demo_path(plover["id"])
    assert len(path["recorded_mm"]) == plover["report"]["samples"]
    assert max(np.diff(path["stamps_s"])) > 1.0, "the stamps are the recording's own"


# ---- proposals --------------------------------------------------------------------------------------------------


def test_proposed_hand_offs_can_be_sent_back_as_a_cut_request(here: Service):
    value, truths = sessions.session(sessions.Kind(seed=1, passes=3))
    about = here.client.add_recording(write_mcap(value))
    mine = [s for s in about["segments"] if s["arm"] == sessions.A]
    assert len(mine) == len(truths)
    for segment in mine:
        assert segment["start_s"] < segment["handover_s"] < segment["end_s"]
        assert (segment["found_by"], segment["reason"]) == ("transfer", "; ".join(segment["reasons"]))
    corrected = {"arm": mine[0]["arm"], "start_s": mine[0]["start_s"] + 0.5, "end_s": mine[0]["end_s"]}
    demo = here.client.cut_demo(about["id"], **KESTREL, **corrected)
    assert demo["start_s"] == pytest.approx(corrected["start_s"], abs=0.011)


# ---- PSM_M ------------------------------------------------------------------------------------------------------


@pytest.fixture
def two_arms(here: Service) -> dict:
    """Release a policy of a demonstration that knows the other arm: its base is computed from the frame of both."""
    here.client.add_demo(beside(), **KESTREL, arm="PSM2")
    here.train(release=True)
    return here.client.demos()[0]


def beside() -> bytes:
    """Return the hand-off of `cases` with PSM1 waiting 15 mm next to its end, approaching along -x."""
    tip = cases.points_mm()
    stamps_ns = cases.START_NS + np.arange(len(tip)) * (10**9 // cases.RATE_HZ)
    down = np.tile([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], (len(tip), 1))
    along_x = np.tile([0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5)], (len(tip), 1))
    waiting = np.tile(np.add(tip[-1], [15.0, 0, 0]), (len(tip), 1))
    motions = (
        Motion("PSM2", "/PSM2/local/measured_cp", "PSM2_base", stamps_ns, tip, down),
        Motion("PSM2", "/PSM2/measured_cp", "world", stamps_ns, tip, down),
        Motion("PSM1", "/PSM1/measured_cp", "world", stamps_ns, waiting, along_x),
    )
    return write_mcap(Recording(format="mcap", integrity="full", motions=motions))


def with_bases() -> bytes:
    """Return the same with PSM1's pose in its own base, which stands 160 mm from PSM2's and is tilted by 35 degrees."""
    recording = read_recording(io.BytesIO(beside()))
    other = recording.motion_of(topic="/PSM1/measured_cp")
    base = matrix_of([BASE_XYZW])[0]
    local = replace(
        other,
        topic="/PSM1/local/measured_cp",
        frame="PSM1_base",
        tip_mm=(other.tip_mm - BASE_MM) @ base,
        rotation_xyzw=quaternion_of(base.T @ matrix_of(other.rotation_xyzw)),
    )
    return write_mcap(replace(recording, motions=(*recording.motions, local)))


def plan(service: Service, **asked: object) -> dict:
    return service.client.plan(**KESTREL, suture_points=[{"position_mm": GOAL_MM}], **asked)


def test_a_plan_takes_psm_ms_approach_from_the_demonstration_and_says_so(here: Service, two_arms: dict):
    partner = two_arms["report"]["partner"]
    assert partner["arm"] == "PSM1"
    assert partner["approach"] == pytest.approx([-1.0, 0.0, 0.0])
    made = plan(here)
    assert made["psm_m"]["approach"] == pytest.approx([-1.0, 0.0, 0.0])
    seen = f"the demonstration: PSM1 at {partner['at_s']:g} s of its recording"
    assert made["psm_m"]["from"] == {"approach": seen, "base": None}
    assert (made["psm_m"]["base_mm"], made["trajectory"]["psm_m_moves"]) == (None, False)
    assert (made["hands_over"], made["a2"]) == (True, "recorded")
    made = plan(here, a2="paper")
    assert (made["hands_over"], made["a2"]) == (True, "paper")
    x, y, z, w = made["passes"][0]["target_xyzw"]
    normal = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    assert abs(normal @ [-1, 0, 0]) == pytest.approx(1.0), "PSM_A's normal is parallel to PSM_M's approach"


def test_a_given_approach_comes_before_the_demonstrated_one(here: Service, two_arms: dict):
    made = plan(here, psm_m={"approach": [0.0, -1.0, 0.0]})
    assert made["psm_m"]["approach"] == [0.0, -1.0, 0.0]
    assert made["psm_m"]["from"] == {"approach": "the request", "base": None}
    assert made["id"] != plan(here)["id"]


def test_psm_ms_base_is_the_demonstrated_one_if_both_bases_were_recorded(here: Service):
    here.client.add_demo(with_bases(), **KESTREL, arm="PSM2")
    here.train(release=True)
    made = plan(here)
    assert made["psm_m"]["base_mm"] == pytest.approx(BASE_MM, abs=1e-6)
    np.testing.assert_allclose(matrix_of([made["psm_m"]["base_xyzw"]])[0], matrix_of([BASE_XYZW])[0], atol=1e-9)
    assert made["psm_m"]["from"]["base"] == made["psm_m"]["from"]["approach"]
    assert made["psm_m"]["from"]["base"].startswith("the demonstration: PSM1 at ")
    assert made["trajectory"]["psm_m_moves"]
    given = plan(here, psm_m={"base": {"position_mm": [150.0, 25.0, 15.0], "rotation_xyzw": BASE_XYZW}})
    assert given["psm_m"]["from"] == {"approach": made["psm_m"]["from"]["approach"], "base": "the request"}
    assert given["psm_m"]["base_mm"] == [150.0, 25.0, 15.0]


def test_a1_alone_is_planned_where_that_is_asked_for(here: Service, two_arms: dict):
    made = plan(here, handoff="none")
    assert (made["psm_m"], made["hands_over"], made["passes"][0]["target_xyzw"]) == (None, False, None)


def test_the_page_shows_the_other_arm(here: Service, two_arms: dict):
    text = here.http.get(f"/demos/{two_arms['id']}/report", headers=PAGE).text
    assert "PSM1 as it takes the needle" in text
    assert 'class="partner"' in text
