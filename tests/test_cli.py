"""The command line, on the application in its own process: what a lab types, in order."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.seeds.recordings import sample_recordings
from skills.settings import settings

STYLE = ("wren", "simple-running")


@pytest.fixture
def skills(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Run a command on a database of this test's own: its exit code, and what it printed."""
    monkeypatch.setenv("SKILLS_DATABASE_URL", f"sqlite:///{tmp_path / 'skills.sqlite'}")
    monkeypatch.delenv("SKILLS_SERVER", raising=False)
    settings.cache_clear()

    def run(*words: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, list(words))
        return result.exit_code, result.output

    yield run
    settings.cache_clear()


def test_from_a_bag_folder_to_a_released_policy_and_a_plan(skills, tmp_path: Path) -> None:
    bag = tmp_path / "rosbag2"
    bag.mkdir()
    (bag / "recording.mcap").write_bytes(next(s for s in sample_recordings() if s.surgeon == "wren").data)
    add = ("demo", "add", str(bag), "--surgeon", "wren", "--suture", "simple-running")
    assert skills("migrate")[0] == 0
    code, said = skills(*add)
    assert (code, "no surgeon 'wren'" in said) == (1, True)
    assert skills("seed")[0] == 0
    code, said = skills(*add, "--proposal", "1", "--grid", "paper", "--json")
    assert code == 0, said
    added = json.loads(said)
    assert added["report"]["grid"]["chosen"] == "paper"
    code, said = skills(*add, "--proposal", "9")
    assert (code, "1 proposed" in said) == (1, True)
    _, said = skills("demo", "list", "--surgeon", "wren", "--json")
    assert added["id"] in [demo["id"] for demo in json.loads(said)]
    code, said = skills("train", *STYLE, "--release", "--json")
    assert (code, json.loads(said)["result"]["released"]) == (0, True), said
    _, said = skills("policy", "show", *STYLE)
    assert "31 of 31 states, DTW 0 mm" in said
    assert "1331 of 1331 reach the goal" in said
    code, said = skills("rollout", *STYLE, "--start", "-30,25,-140", "--json")
    assert json.loads(said)["finished"]
    exported = tmp_path / "policy.json"
    assert skills("policy", "export", *STYLE, str(exported))[0] == 0
    assert json.loads(exported.read_bytes())["surgeon"] == "wren"
    code, said = skills("plan", *STYLE, "--point", "5,55,-120", "--json")
    assert (code, len(json.loads(said)["passes"])) == (0, 1)
    code, said = skills("plan", *STYLE, "--point", "5,555,-120")
    assert (code, "insertion" in said) == (1, True)
    assert skills("policy", "withdraw", *STYLE)[0] == 0
    code, said = skills("policy", "show", *STYLE)
    assert (code, "No policy" in said) == (1, True)
    assert skills("erase", "wren", "--yes")[0] == 0
    code, said = skills("train", *STYLE)
    assert (code, "erased for good" in said) == (1, True)


def test_a_demonstration_with_hysteresis_tells_its_states_crossings_and_loss(skills, tmp_path: Path) -> None:
    bag = tmp_path / "plover.mcap"
    bag.write_bytes(next(s for s in sample_recordings() if s.surgeon == "plover").data)
    assert skills("seed")[0] == 0
    add = ("demo", "add", str(bag), "--surgeon", "plover", "--suture", "simple-running", "--proposal", "1")
    code, said = skills(*add)
    assert (code, "19 crossings" in said) == (0, True), said
    code, said = skills(*add, "--hysteresis", "0.25")
    assert (code, "0 crossings; samples are 1.56, 1.54, 1.56 mm off" in said) == (0, True), said
    _, said = skills(*add, "--hysteresis", "0.25", "--json")
    assert (json.loads(said)["hysteresis"], json.loads(said)["path_states"]) == (0.25, 18)
    code, said = skills(*add, "--hysteresis", "0.6")
    assert (code, "less than or equal to 0.5" in said) == (1, True), said


def test_what_is_no_recording_is_refused_with_a_sentence(skills, tmp_path: Path) -> None:
    code, said = skills("recording", "add", str(tmp_path))
    assert (code, "exactly one .mcap" in said) == (1, True)
    code, said = skills("plan", *STYLE, "--point", "here")
    assert (code, "three numbers" in said) == (1, True)
