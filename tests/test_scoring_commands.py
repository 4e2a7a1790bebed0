"""`skills score` and `skills calibrate`, on the application in this process."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from skills.seeds.recordings import sample_recordings
from tests.library import rated

STYLE = ("--surgeon", "kestrel", "--suture", "simple-running")
Run = Callable[..., tuple[int, str]]


def test_a_file_is_scored_by_its_proposed_hand_off(skills: Run, tmp_path: Path) -> None:
    sample = next(one for one in sample_recordings() if one.surgeon == "plover")
    several = next(one for one in sample_recordings() if len(one.segments) > 1)
    file, many = tmp_path / "plover.mcap", tmp_path / "many.mcap"
    file.write_bytes(sample.data)
    many.write_bytes(several.data)
    skills.does("seed")
    scored = skills.json("score", str(file), *STYLE)
    assert scored["demo"] is None and scored["recording"]
    (start_s, end_s) = sample.segments[0]
    assert scored["start_s"] == pytest.approx(start_s, abs=0.3) and scored["end_s"] == pytest.approx(end_s, abs=0.6)
    code, said = skills("score", str(file), *STYLE, "--start-s", str(start_s), "--end-s", str(end_s), "--json")
    assert json.loads(said)["end_s"] == pytest.approx(end_s, abs=0.02)
    code, said = skills("score", str(many), *STYLE)
    assert code == 1 and "5 proposed hand-offs" in said and "--proposal" in said, said
    code, said = skills("score", str(many), *STYLE, "--proposal", "2")
    assert code == 0 and "not a credential" in said, said


@pytest.mark.parametrize("what", ["nowhere.mcap", "0" * 64])
def test_what_is_not_there_is_said(skills: Run, what: str) -> None:
    skills.does("seed")
    code, said = skills("score", what, *STYLE)
    assert code == 1 and "There is no" in said, said


@pytest.mark.nightly  # by day tests/library
def test_a_folder_is_calibrated_on_and_used_by_the_next_score(skills: Run, tmp_path: Path) -> None:
    lab = rated.folder(tmp_path / "lab")
    about = skills.json("calibrate", str(lab), "--permutations", "39")
    assert about["data"]["trials"] == 40 and about["validated"]["mean"]["model"]["rho"] > 0.8
    skills.does("seed")
    trial = sorted((lab / "Suturing/kinematics/AllGestures").iterdir())[0]
    part = ("--arm", "PSM_right", "--start-s", "1", "--end-s", "4")
    skill = skills.json("score", str(trial), *STYLE, *part, "--task", "Suturing")["skill"]
    assert skill["calibrated"] and skill["calibration"] == about["sha256"]
    code, said = skills("calibrate", str(tmp_path / "lab" / "Suturing" / "transcriptions"))
    assert code == 1 and "has no trials of JIGSAWS" in said, said


def test_the_figures_of_a_refused_model_are_printed_as_json_too(skills: Run, tmp_path: Path) -> None:
    lab = rated.folder(tmp_path / "lab", count=4, trials=3)
    code, said = skills("calibrate", str(lab), "--permutations", "39", "--json")
    assert code == 1, said
    about, _ = json.JSONDecoder().raw_decode(said[said.index("{") :])
    assert about["sha256"] is None and about["data"]["trials"] == 12 and "Suturing" in about["validated"]["tasks"]
    assert "The model is not accepted" in said
