"""Values in a notebook: escaped, without scripts and addresses, in the notebook's own colours."""

from dataclasses import replace
from html import escape
from io import BytesIO
from xml.etree import ElementTree

import numpy as np
import pytest

import skills
from skills.notebook import card
from skills.seeds.recordings import sample_recordings
from skills.verification.gates import Failure
from tests.planning.motions import ideal_playback

HOSTILE = "<script src='//elsewhere'>&"
TAGS = {"div", "table", "caption", "tbody", "tr", "th", "td", "svg", "rect", "text", "polyline", "circle", "span"}


@pytest.fixture(scope="module")
def values() -> dict[str, object]:
    sample = sample_recordings()[2]
    recording = skills.read_recording(BytesIO(sample.data))
    demo = replace(skills.cut_demo(recording, start_s=sample.segments[0][0], end_s=sample.segments[0][1]), arm=HOSTILE)
    reward = skills.sparse_reward(skills.discretize(demo.tip_mm, skills.PAPER_GRID))
    policy = skills.learn_policy(reward, skills.PhaseQLearning())
    plan = skills.stack(policy, [skills.SuturePoint((0.0, 55.0, -125.0))], demo=demo)
    trajectory = skills.time_parametrise(plan.passes)
    verdict = skills.judge(ideal_playback(trajectory), trajectory)
    return {"Demonstration": demo, "Policy": policy, "Plan": plan, "Verdict": verdict}


@pytest.mark.parametrize("name", ["Demonstration", "Policy", "Plan", "Verdict"])
def test_a_value_is_one_small_element_of_text_and_lines(values, name):
    html = values[name]._repr_html_()
    whole = ElementTree.fromstring(html)  # what is not escaped or not closed is refused
    assert name in "".join(whole.itertext())
    assert {one.tag for one in whole.iter()} <= TAGS
    assert not [key for one in whole.iter() for key in one.attrib if key.startswith("on") or key in ("href", "src")]
    styles = " ".join(one.get("style", "") for one in whole.iter())
    assert "currentColor" in styles or name == "Verdict"
    assert not any(word in styles for word in ("#", "rgb", "url", "black", "white"))  # the notebook's own colours
    assert len(html) < 20_000
    assert (whole.find(".//polyline") is not None) == (name != "Verdict")


def test_what_others_named_is_escaped(values):
    html = values["Demonstration"]._repr_html_()
    assert "<script" not in html
    assert "&lt;script" in html


def test_the_learnt_path_is_compared_with_the_demonstration(values):
    assert "the demonstration, state by state" in values["Policy"]._repr_html_()


def test_a_verdict_names_its_first_failure_and_what_was_not_measured(values):
    report = values["Verdict"]
    assert "Verdict: feasible" in report._repr_html_()
    failure = Failure(7, 0, 0, 0.035, HOSTILE, 3.0, 2.0, "mm", 4.0, 0.05)
    html = replace(report, feasible=False, failure=failure, executed_off_mm=float("nan"))._repr_html_()
    assert "Verdict: not feasible" in html
    assert escape(str(failure)) in html
    assert "not measured" in html


def test_one_point_and_a_straight_line_are_drawn_at_a_finite_scale():
    for points in (np.zeros((1, 3)), np.zeros((2, 3)), np.array([[0.0, 0, 0], [0, 0, 5]])):
        assert "nan" not in card("Demonstration", {}, {"recorded": [points]})
