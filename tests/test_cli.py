"""The command line, on the application in its own process: a lab's commands, in order.

Jobs are carried out by a thread (`cases.working`), except in one test, where the commands start their worker.
"""

import io
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.cli.connecting import MANY, connect
from skills.db.session import Database
from skills.formats import read_recording
from skills.formats.bag_writer import write_mcap
from skills.formats.lerobot.cut import find_dataset
from skills.formats.lerobot.writer import AboutDataset, ExportedEpisode, dataset_files
from skills.gridworld.scene import Scene
from skills.jobs.in_process import InProcess
from skills.seeds.recordings import sample_recordings
from skills.settings import Settings, settings
from skills.simulation import film
from tests.arms import ARMS
from tests.formats import bags, lerobots, trials, videos
from tests.library import cases, exports
from tests.library.test_pose_styles import both_arms

STYLE = ("wren", "simple-running")


def test_workers_start_for_batches_and_a_single_job_runs_in_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crews: list[int] = []

    @contextmanager
    def working(given: Settings) -> Iterator[None]:
        crews.append(given.workers)
        yield

    monkeypatch.setattr("skills.serving.working", working)
    alone: list[Settings] = []
    monkeypatch.setattr(InProcess, "_run", lambda self: alone.append(self._settings))
    of_four = Settings(database_url=f"sqlite:///{tmp_path / 'skills.sqlite'}", workers=4)
    for given, workers in ((of_four, 0), (of_four, 1), (of_four, MANY), (of_four.model_copy(update={"workers": 0}), 1)):
        with connect(given, workers=workers):
            pass
    assert crews == [4]
    assert alone == [of_four]  # SKILLS_WORKERS=0 says that workers run elsewhere


def test_a_dataset_is_exported_verified_and_never_overwritten(skills, tmp_path: Path) -> None:
    file = tmp_path / "hand-off.mcap"
    file.write_bytes(write_mcap(exports.session_of()))
    skills.does("migrate")
    skills.does("surgeon", "put", "kestrel")
    skills.does("suture", "list")
    add = ("demo", "add", str(file), "--surgeon", "kestrel", "--suture", "simple-running", "--arm", "PSM1")
    skills.does(*add, "--segment", "whole")
    out = str(tmp_path / "dataset")
    asked = ("export-dataset", out, "--surgeon", "kestrel", "--licence", "CC-BY-4.0", "--fps", "25")
    skills.does(*asked, says="episodes: 1, frames: 30")
    with find_dataset(tmp_path / "dataset") as unpacked:
        assert unpacked.tasks == {0: "Simple running"}
    for existing in (out, str(file)):
        skills.refuses("export-dataset", existing, says="exists already")


@pytest.mark.nightly  # by day tests/formats
def test_videos_of_the_users_own_dataset_are_exported_with_the_recordings(skills, tmp_path: Path) -> None:
    theirs = lerobots.write(videos.dataset("v2.1"), tmp_path / "theirs")
    skills.does("migrate")
    skills.does("surgeon", "put", "kestrel")
    skills.does("suture", "list")
    stated = ("--frame", "ECM", "--surgeon", "kestrel", "--suture", "simple-running", "--arm", "PSM1")
    for number in (2, 0):
        skills.does("demo", "add", str(theirs), "--episode", str(number), *stated, "--segment", "whole")
    out = tmp_path / "dataset"
    asked = ("export-dataset", str(out), "--whole", "--videos", str(theirs), "--pictures-consented")
    for left_out, fault in (("--whole", "not cut at a hand-off"), ("--pictures-consented", "declare it with")):
        code, said = skills(*(word for word in asked if word != left_out))
        assert (code, fault in said) == (1, True), said
    skills.refuses("export-dataset", str(tmp_path / "dataset.zip"), *asked[2:], says="written to a folder")
    skills.refuses("export-dataset", str(out), "--whole", "--pictures-consented", says="are about --videos")
    code, said = skills(*asked)
    assert (code, "episodes: 2, frames: 100" in said, "declared the consent" in said) == (0, True, True), said
    shown = [videos.shown(one) for one in sorted(out.glob(f"videos/*/{videos.CAMERAS[0]}/*.mp4"))]
    assert shown == [[*range(90, 150)], [*range(40)]]
    (theirs / f"videos/chunk-000/{videos.CAMERAS[1]}/episode_000002.mp4").unlink()
    asked = ("export-dataset", str(tmp_path / "more"), *asked[2:])
    skills.refuses(*asked, says="There is no video of observation.images.wrist for episode 2")
    assert sorted(one.name for one in tmp_path.iterdir() if one.is_dir()) == ["dataset", "theirs"]


def test_from_a_bag_folder_to_a_released_policy_and_a_plan(skills, tmp_path: Path) -> None:
    bag = tmp_path / "rosbag2"
    bag.mkdir()
    (bag / "recording.mcap").write_bytes(next(s for s in sample_recordings() if s.surgeon == "wren").data)
    add = ("demo", "add", str(bag), "--surgeon", "wren", "--suture", "simple-running")
    skills.does("migrate")
    skills.refuses(*add, says="no surgeon 'wren'")
    skills.does("seed")
    added = skills.json(*add, "--proposal", "1", "--grid", "paper")
    assert added["report"]["grid"]["chosen"] == "paper"
    skills.refuses(*add, "--proposal", "9", says="1 hand-off is proposed")
    assert added["id"] in [demo["id"] for demo in skills.json("demo", "list", "--surgeon", "wren")]
    code, said = skills("train", *STYLE, "--release", "--json")
    assert (code, json.loads(said)["result"]["released"]) == (0, True), said
    _, said = skills("policy", "show", *STYLE)
    assert "31 of 31 states, DTW 0 mm" in said
    assert "38% of the demonstration from a start on average, median 23%; 160 of 1331 starts see the goal alone" in said
    assert "1331 of 1331 reach the goal" in said
    code, said = skills("train", *STYLE, "--join", "0.5", "--json")
    assert json.loads(said)["request"]["learner"]["join_share"] == 0.5
    assert "76% of the demonstration" in skills("policy", "show", *STYLE, "--version", "2")[1]
    skills.refuses("train", *STYLE, "--join", "sometimes", says="Write nearest, start, or a share from 0 to 1")
    skills.refuses(
        "train", *STYLE, "--join", "start", "--learner", "cell-q-learning", says="cell-q-learning has no joining rule"
    )
    skills.refuses(
        "train", *STYLE, "--learner", "cell-q-learning", "--setting", "gamma=0.95", says="use a gamma below 0.9"
    )
    (tmp_path / "scene.json").write_text(json.dumps(Scene(added["frame"], margin_mm=0.5).as_json()))
    in_scene = ("--scene", str(tmp_path / "scene.json"), "--learner", "value-iteration", "--setting", "gamma=0.95")
    code, said = skills("train", *STYLE, *in_scene, "--scene-cost", "touch=50", "--json")
    asked = json.loads(said)["request"]["surroundings"]
    assert (code, asked["costs"]["touch"], asked["scene"]["margin_mm"]) == (0, 50, 0.5)
    skills.refuses("train", *STYLE, "--scene", str(bag / "recording.mcap"), says="cannot be read as JSON")
    code, said = skills("rollout", *STYLE, "--start", "-30,25,-140", "--json")
    assert json.loads(said)["finished"]
    exported = tmp_path / "policy.json"
    skills.does("policy", "export", *STYLE, str(exported))
    assert json.loads(exported.read_bytes())["surgeon"] == "wren"
    code, said = skills("plan", *STYLE, "--point", "5,55,-120", "--no-handoff", "--json")
    assert (code, len(json.loads(said)["passes"])) == (0, 1)
    skills.refuses("plan", *STYLE, "--point", "5,555,-120", "--no-handoff", says="insertion")
    skills.does("policy", "withdraw", *STYLE)
    skills.refuses("policy", "show", *STYLE, says="No policy")
    skills.does("erase", "wren", "--yes")
    skills.refuses("train", *STYLE, says="erased permanently")
    code, said = skills("seed")
    assert (code, "plover" in said, "Some samples are not loaded. wren: " in said) == (1, True, True), said


def test_a_command_trains_with_a_worker_process_of_its_own(with_worker) -> None:
    with_worker.does("seed")
    code, said = with_worker("train", *STYLE, "--release", "--json")
    assert (code, json.loads(said)["result"]["released"]) == (0, True), said


@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.nightly)])  # by day the demo draws
def test_a_plan_is_played_drawn_exported_and_its_bag_verified(
    skills, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drawn: bool
) -> None:
    monkeypatch.setattr(film, "FRAMES", 4)
    monkeypatch.setattr(film, "FRAMES_PER_PASS", 4)
    skills.does("seed")
    skills.does("train", *STYLE, "--release")
    base = "160,20,20,0,0,0.38268343236509,0.923879532511287"
    both = ("--approach", "-0.94,0.10,-0.33", "--base", base, "--tissue-mm=-170")
    plan = skills.json("plan", *STYLE, "--point", "5,55,-120", *both, "--rate-hz", "100")["id"]
    code, said = skills("export", plan, str(tmp_path / "early.zip"))
    assert (code, "was not played" in said, (tmp_path / "early.zip").exists()) == (1, True, False), said
    own = tmp_path / "arms.json"
    own.write_text('{"registration_mm": 0.3}')
    code, said = skills("play", plan, "--errors", str(own))
    assert (code, "JSON with name, registration_mm" in said, "calibrate-arm" in said) == (1, True, True), said
    own.write_text(json.dumps(asdict(ARMS)))
    driven = tmp_path / "servo.json"
    driven.write_text('{"velocitys": false}')
    code, said = skills("play", plan, "--servo", str(driven))
    assert (code, "velocitys" in said, "docs/execution.md" in said) == (1, True, True), said
    driven.write_text('{"gravity_compensated": true}')
    pictures = ("--pictures", str(tmp_path / "pictures")) if drawn else ()
    code, said = skills("play", plan, "--errors", str(own), "--servo", str(driven), *pictures)
    assert (code, "feasible" in said, "bench: registration 0.3 mm" in said) == (0, True, True), said
    assert "The tip is predicted" in said and "Not validated on hardware" in said
    kinds = {"playback.png": b"\x89PNG", "joints.png": b"\x89PNG", "clearance.png": b"\x89PNG", "playback.gif": b"GIF8"}
    for name, begins in kinds.items() if drawn else ():
        assert (tmp_path / "pictures" / name).read_bytes().startswith(begins)
    assert not drawn or (tmp_path / "pictures" / "playback.mp4").read_bytes()[4:8] == b"ftyp"
    bag = tmp_path / "bag.zip"
    skills.does("export", plan, str(bag))
    skills.refuses("export", plan, str(bag), says="Replace it: --force")
    skills.does("export", plan, str(bag), "--force")
    code, said = skills("plans", "--json")
    (listed,) = json.loads(said)
    assert (listed["id"], listed["passes"], listed["feasible"]) == (plan, 1, True)
    skills.does("plans", plan[:8], says="hands the needle to PSM_M")
    skills.does("verify", str(bag))
    damaged = bytearray(bag.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    bag.write_bytes(bytes(damaged))
    code, said = skills("verify", str(bag))
    assert code == 1, said
    skills.refuses("plan", *STYLE, "--point", "5,55,-120", "--base", "1,2,3", says="7 numbers")
    skills.refuses("plan", *STYLE, says="--point")


def test_of_several_hand_offs_one_is_named_or_asked_for(
    skills, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    skills.does("seed")
    file = tmp_path / "five.mcap"
    file.write_bytes(next(s for s in sample_recordings() if len(s.segments) > 1).data)
    add = ("demo", "add", str(file), "--surgeon", "kestrel", "--suture", "simple-interrupted")
    said = skills.refuses(*add, says="--segment whole")
    assert said.count("PSM2") >= 5, said
    code, said = skills(*add, "--json")
    assert (code, len(json.loads(said)["numbers"]["segments"])) == (1, 5)
    skills.does(*add, "--segment", "2", says="Taken: proposal 2 of 5")
    skills.does(*add, "--segment", "whole", says="Taken: the whole recording")
    skills.refuses(*add, "--segment", "both", says="'both' is neither")
    monkeypatch.setattr("skills.cli.demos.on_terminal", lambda: True)
    result = CliRunner().invoke(app, list(add), input="3\n")
    assert (result.exit_code, "Taken: proposal 3 of 5" in result.output) == (0, True), result.output


def test_the_first_real_bag_of_a_new_user_is_learnt_and_released(skills) -> None:
    bag = str(bags.sample_folder() / "rosbag2")
    skills.does("seed")
    skills.does("surgeon", "put", "newcomer")
    style = ("newcomer", "simple-running")
    skills.does("demo", "add", bag, "--surgeon", style[0], "--suture", style[1], says="Taken: proposal 1 of 1, 7.0")
    assert skills.json("train", *style, "--release")["result"]["released"]
    camera = (bag, "--surgeon", style[0], "--suture", style[1], "--topic", "/PSM2/measured_cp")
    skills.does("demo", "add", *camera)
    code, said = skills("train", *style, "--release")
    assert (code, "ECM" in said, "local/measured_cp" in said) == (1, True, True), said  # the reason, and the remedy


@pytest.mark.nightly  # by day tests/library
def test_a_style_is_learnt_from_several_demonstrations(skills, tmp_path: Path) -> None:
    skills.does("migrate")
    skills.does("seed")
    style = ("kestrel", "simple-interrupted")
    file = tmp_path / "five.mcap"
    file.write_bytes(next(s for s in sample_recordings() if len(s.segments) > 1).data)
    named = []
    for proposal in ("1", "2", "3"):
        add = ("--surgeon", style[0], "--suture", style[1], "--proposal", proposal, "--json")
        named += ["--demo", json.loads(skills("demo", "add", str(file), *add)[1])["id"]]
    code, said = skills("train", *style, *named, "--combine", "medoid", "--json")
    job = json.loads(said)
    assert (code, job["request"]["combine"], job["result"]["releasable"]) == (0, {"kind": "medoid"}, True), said
    assert sorted(job["request"]["demos"]) == sorted(named[1::2])
    assert skills("train", *style, *named[:2], "--combine", "medoid")[0] == 1


def test_a_pose_style_names_the_other_arm_and_that_it_has_no_tube(skills, tmp_path: Path) -> None:
    skills.does("migrate")
    skills.does("seed")
    file, style = tmp_path / "both.mcap", ("kestrel", cases.SUTURE)
    file.write_bytes(both_arms())
    add = ("--surgeon", style[0], "--suture", style[1], "--arm", "PSM2", "--segment", "whole")
    skills.does("demo", "add", str(file), *add)
    skills.does("train", *style, "--release")
    code, said = skills("policy", "pose-style", *style)
    assert code == 0 and "beside  PSM1 as demonstrated, without a tube; check the distance between the arms" in said


def test_a_failure_is_marked_listed_and_learnt_from_on_request(skills, tmp_path: Path) -> None:
    skills.does("seed")
    (tmp_path / "hand-off.csv").write_bytes(cases.hand_off())
    add = ("demo", "add", str(tmp_path / "hand-off.csv"), "--surgeon", "plover", "--suture", "horizontal-mattress")
    code, said = skills(*add, "--outcome", "failure")
    assert (code, said.startswith("A failure needs a reason")) == (1, True), said
    code, said = skills(*add, "--outcome", "failure", "--reason", "The needle fell.", "--json")
    demo = json.loads(said)
    assert (demo["outcome"], demo["outcome_reason"]) == ("failure", "The needle fell.")
    assert [one["id"] for one in skills.json("demo", "list", "--outcome", "failure")] == [demo["id"]]
    style = ("plover", "horizontal-mattress")
    skills.refuses("train", *style, says="learn from it all the same: --outcomes any")
    code, said = skills("train", *style, "--outcomes", "any", "--json")
    assert (code, json.loads(said)["request"]["outcomes"]) == (0, "any")
    said = skills("erasures", str(tmp_path / "erasures.json"))[1]
    assert "1 demonstrations marked recovery or failure." in " ".join(said.split())
    code, said = skills(*add, "--outcome", "success")
    assert (code, f"skills demo mark {demo['id']} success" in said.replace("\n", "")) == (1, True), said
    assert skills("demo", "mark", demo["id"], "success") == (0, "marked success\n")
    assert "marked success" in skills("demo", "show", demo["id"])[1]
    skills.does("train", *style)


def test_a_batch_trains_styles_names_failures_and_sets_the_exit_code(skills) -> None:
    skills.does("seed")
    code, said = skills("retrain", "--only-stale", "--release", "--json")
    batch = json.loads(said[said.index("{") :])
    assert (code, batch["state"], batch["styles"]["failed"]) == (0, "succeeded", 0), said
    assert batch["styles"]["done"] == len(batch["items"]) > 3
    assert all(style["comparison"]["now_released"] for style in batch["items"])
    database = Database(settings().database_url)
    with database.writing() as session:
        cases.agree(session, {"uses": [], "until": None}, "wren")
    database.close()
    code, said = skills("retrain", "--surgeon", "wren", "--release")
    assert (code, "does not cover training" in said, "failed" in said) == (1, True, False), said
    code, said = skills("retrain", "--suture", "simple-running")
    assert (code, "1 failed" in said, "does not cover training" in said) == (1, True, True), said


def test_an_unreleased_version_gives_reason_remedy_and_exit_code(skills, tmp_path: Path) -> None:
    below = tmp_path / "below.csv"
    below.write_bytes(cases.hand_off((0.0, 0.0, -400.0)))
    skills.does("surgeon", "put", "kestrel")
    skills.does("demo", "add", str(below), "--surgeon", "kestrel", "--suture", cases.SUTURE)
    for words in (("train", "kestrel", cases.SUTURE), ("retrain",)):
        code, said = skills(*words, "--release")
        assert code == 1, said
        assert "version 1 cannot be released: " in said.lower()
        assert "joint limits" in said
        assert "Record the hand-off further inside the arm's reach" in said
        assert "Traceback" not in said


@pytest.mark.nightly  # by day tests/library
def test_a_demo_with_hysteresis_reports_states_crossings_and_loss(skills, tmp_path: Path) -> None:
    bag = tmp_path / "plover.mcap"
    bag.write_bytes(next(s for s in sample_recordings() if s.surgeon == "plover").data)
    skills.does("seed")
    add = ("demo", "add", str(bag), "--surgeon", "plover", "--suture", "simple-running", "--proposal", "1")
    skills.does(*add, says="19 crossings")
    skills.does(*add, "--hysteresis", "0.25", says="0 crossings; samples are 1.58, 1.60, 1.56 mm off")
    stored = skills.json(*add, "--hysteresis", "0.25")
    assert (stored["hysteresis"], stored["report"]["path_states"]) == (0.25, 18)
    code, said = skills("demo", "report", stored["id"], "--json")
    assert (code, json.loads(said)["report"]["path_states"]) == (0, 18), said
    skills.does("demo", "report", stored["id"], "--html", str(tmp_path / "report.html"))
    page = (tmp_path / "report.html").read_text()
    assert page.startswith("<!doctype html>") and "plover" in page
    skills.refuses(*add, "--hysteresis", "0.6", says="--hysteresis must be at most 0.5; 0.6 was given")


def test_what_is_no_recording_is_refused_with_a_sentence(skills, tmp_path: Path) -> None:
    skills.refuses("recording", "add", str(tmp_path), says="has no .mcap, .db3 or .bag file")
    skills.refuses("plan", *STYLE, "--point", "here", says="3 numbers")


def test_a_sessions_folder_is_joined_without_its_pictures(skills, tmp_path: Path) -> None:
    session = tmp_path / "session"
    (session / "rosbag").mkdir(parents=True)
    (session / "rosbag" / "a_0.mcap").write_bytes(write_mcap(bags.recording()))
    start = {"cpu_ts": bags.START_NS}
    (session / "x_tags.json").write_text(json.dumps({"stages": [{"name": "A1", "start": start, "end": start}]}))
    stored = skills.json("recording", "add", str(session))
    assert (stored["format"], stored["integrity"], stored["media_type"]) == ("rosbag2", "full", "application/zip")
    assert skills.json("recording", "add", str(session))["sha256"] == stored["sha256"]


def test_episodes_of_a_lerobot_dataset_are_recordings_of_their_own(skills, tmp_path: Path) -> None:
    folder = str(lerobots.write(lerobots.dataset("v3.0"), tmp_path / "dataset"))
    add = ("recording", "add", folder, "--frame", "ECM", "--json")
    code, said = skills(*add)
    assert (code, "has 3 episodes" in said, "--episode N" in said) == (1, True, True)
    said = skills.does(*add, "--episode", "1")
    assert (json.loads(said)["format"], json.loads(said)["notes"]["episode"]) == ("lerobot", "1")
    code, said = skills(*add, "--episode", "all")
    stored = json.loads(said)
    assert (code, [one["episode"] for one in stored]) == (0, [0, 1, 2])
    assert stored[1]["recording"] == json.loads(skills(*add, "--episode", "1")[1])["sha256"]
    assert len({one["recording"] for one in stored}) == 3
    code, said = skills("recording", "add", folder, "--episode", "all", "--json")
    assert code == 1
    assert all("--frame ECM" in one["problem"] for one in json.loads(said))
    skills.refuses(*add, "--episode", "7", says="0 to 2")


def test_from_a_lerobot_folder_to_a_released_policy(skills, tmp_path: Path) -> None:
    sample = next(one for one in sample_recordings() if one.surgeon == "wren")
    given = [ExportedEpisode(read_recording(io.BytesIO(sample.data)), "simple running suture")]
    for name, file in dataset_files(given, AboutDataset("Wren", ("PSM2",), fps=100), "v3.0"):
        lerobots.write({name: file.read()}, tmp_path / "dataset")
    skills.does("migrate")
    skills.does("surgeon", "put", "wren", "--consent", "training")
    add = (
        "demo",
        "add",
        str(tmp_path / "dataset"),
        "--episode",
        "0",
        "--surgeon",
        "wren",
        "--suture",
        "simple-running",
    )
    assert skills.json(*add)["frame"] == "PSM2_base"
    code, said = skills("train", *STYLE, "--release", "--json")
    assert (code, json.loads(said)["result"]["released"]) == (0, True), said


def test_a_demonstration_is_cut_out_of_an_episode(skills, tmp_path: Path) -> None:
    columns, names = lerobots.joint_columns([f"motor_{k}" for k in range(7)])
    del columns["observation.meta.tool.psm1"]
    folder = str(lerobots.write(lerobots.episode(columns, names=names), tmp_path / "dataset"))
    said_columns = [word for k in range(6) for word in ("--column", f"psm1_joint_{k + 1}=motor_{k}")]
    add = ("demo", "add", folder, "--surgeon", "wren", "--suture", "simple-running", "--segment", "whole", "--json")
    skills("migrate")
    skills("surgeon", "put", "wren")
    skills.refuses(*add, *said_columns, says="--tool PSM1=400006")
    said = skills.does(*add, *said_columns, "--tool", "PSM1=400006")
    assert (json.loads(said)["arm"], json.loads(said)["frame"]) == ("PSM1", "PSM1_base")
    skills.refuses(*add, "--column", "psm1_jaw", says="two names with = between them")


def test_what_is_said_about_a_dataset_is_refused_for_other_files(skills, tmp_path: Path) -> None:
    (tmp_path / "bag.mcap").write_bytes(write_mcap(bags.recording()))
    for more in (("--episode", "0"), ("--episode", "all"), ("--tool", "PSM1=400006")):
        code, said = skills("recording", "add", str(tmp_path / "bag.mcap"), *more)
        assert (code, "is no LeRobot dataset" in said.replace("\n", " ")) == (1, True)


def test_the_content_says_what_a_file_is_and_not_its_name(skills, tmp_path: Path) -> None:
    said_by = {
        "table.mcap": (b"x_m,y_m,z_m\n0,0.05,-0.12\n0.01,0.05,-0.12\n0.02,0.05,-0.12\n", "csv"),
        "bag.csv": (write_mcap(bags.recording()), "mcap"),
        "trial.csv": (trials.text(trials.kinematics()), "jigsaws"),
    }
    for name, (data, kind) in said_by.items():
        (tmp_path / name).write_bytes(data)
        how = ("--rate-hz", "100", "--frame", "PSM1_base") if kind == "csv" else ()
        code, said = skills("recording", "add", str(tmp_path / name), *how, "--json")
        assert (code, json.loads(said)["format"]) == (0, kind), said


def test_a_jigsaws_folder_is_stored_with_one_command(skills, tmp_path: Path) -> None:
    root = trials.folder(tmp_path / "jigsaws")
    add = ("jigsaws", "add", str(root), "--suture", "simple-interrupted", "--arm", "PSM_right", "--json")
    code, said = skills(*add)
    first = json.loads(said)
    assert code == 0, said
    assert [(one["trial"], one["surgeon"], one["skill_level"], one["score"]) for one in first] == [
        ("Suturing_B001", "jigsaws-b", "novice", 13),
        ("Suturing_C002", "jigsaws-c", "expert", 27),
    ]
    assert all(one["proposed"] == len(one["demos"]) >= 1 for one in first)
    assert json.loads(skills(*add)[1]) == first  # the same again: nothing is stored twice
    demos = skills.json("demo", "list", "--surgeon", "jigsaws-b")
    assert sorted(demo["id"] for demo in demos) == sorted(first[0]["demos"])
    assert {(demo["arm"], demo["frame"], demo["suture"]) for demo in demos} == {
        ("PSM_right", "jigsaws", "simple-interrupted")
    }


def test_proposed_hand_offs_are_compared_with_the_transcribed_ones(skills, tmp_path: Path) -> None:
    root = trials.folder(tmp_path / "jigsaws")
    (root / "Suturing" / "kinematics" / "AllGestures" / "Suturing_C003.txt").write_bytes(b"")
    code, said = skills("jigsaws", "evaluate", str(root), "--json")
    (one,) = json.loads(said)
    assert code == 0
    assert (one["task"], one["trials"], one["left_out"], one["labelled"]) == ("Suturing", 2, 1, 2)
    assert one["labels"] == "transcription"
    assert one["recall"] * one["labelled"] == pytest.approx(one["precision"] * one["proposed"])
    assert one["brier"] is None, "both jaws move at once, so that no transfer gives a confidence"
    _, said = skills("jigsaws", "evaluate", str(root))
    assert "transcription" in said and "Suturing" in said


def test_without_labels_an_evaluation_says_why_it_is_empty(skills, tmp_path: Path) -> None:
    root = trials.folder(tmp_path / "jigsaws")
    shutil.rmtree(root / "Suturing" / "transcriptions")
    (one,) = json.loads(skills("jigsaws", "evaluate", str(root), "--json")[1])
    assert one["proposed"] > 0
    assert [one[name] for name in ("labels", "labelled", "precision", "recall", "error_s", "brier")] == [None] * 6
    code, said = skills("jigsaws", "evaluate", str(root))
    assert code == 0
    assert "Suturing: no trial has a transcription or motion primitives (--primitives)" in said


def test_proposed_transfers_are_compared_with_motion_primitives(skills, tmp_path: Path) -> None:
    """The right hand opens at 5 s and has moved 5 mm from the left one at 5.5 s; the left one gives nothing."""
    root = trials.folder(tmp_path / "jigsaws")
    (root / "Suturing" / "kinematics" / "AllGestures" / "Suturing_C002.txt").unlink()
    shutil.rmtree(root / "Suturing" / "transcriptions")
    table = trials.handing_over(opens_s=5.0, parts_s=5.5)
    (root / "Suturing" / "kinematics" / "AllGestures" / "Suturing_B001.txt").write_bytes(trials.text(table))
    labels = tmp_path / "labels"
    labels.mkdir()
    lines = (
        "Start Stop Motion Primitive",
        "0 129 Grasp(L, Needle)",
        "130 169 Release(R, Needle)",
        "170 239 Pull(L, Needle)",
    )
    (labels / "Suturing_S02_T01.txt").write_text("\n".join(lines))
    command = ("jigsaws", "evaluate", str(root), "--primitives", str(labels), "--json")
    transfers, openings = json.loads(skills(*command)[1])
    assert [transfers[name] for name in ("labels", "proposed", "labelled", "precision", "recall")] == [
        "motion primitives", 1, 1, 1.0, 1.0,
    ]  # fmt: skip
    assert transfers["error_s"] == pytest.approx(170 / 30 - 5.5, abs=0.1)
    assert (openings["proposals"], openings["proposed"], openings["precision"]) == ("a jaw opens", 2, 0.5)
    (labels / "Suturing_S02_T01.txt").write_text("\n".join(lines).replace("R, Needle", "L, Needle", 1))
    transfers, _ = json.loads(skills(*command)[1])
    assert (transfers["labelled"], transfers["precision"], transfers["recall"]) == (0, 0.0, None)


def test_a_proposal_in_one_cell_is_named_and_left_out(skills, tmp_path: Path) -> None:
    root = trials.folder(tmp_path / "jigsaws")
    shutil.rmtree(root / "Suturing" / "transcriptions")
    (root / "Suturing" / "kinematics" / "AllGestures" / "Suturing_B001.txt").write_bytes(trials.text(trials.swaying()))
    code, said = skills("jigsaws", "add", str(root), "--suture", "simple-interrupted", "--json")
    small, large = json.loads(said)
    assert code == 0, said
    assert [(one["problems"], one["proposed"]) for one in (small, large)] == [([], 2), ([], 2)]
    assert (small["demos"], len(small["left_out"]), len(large["demos"]), large["left_out"]) == ([], 2, 2, [])
    assert all("one cell" in part for part in small["left_out"])
    _, said = skills("jigsaws", "add", str(root), "--suture", "simple-interrupted")
    assert "Suturing_B001, left out: PSM_" in said


def test_a_trial_that_is_refused_does_not_stop_the_others(skills, tmp_path: Path) -> None:
    root = trials.folder(tmp_path)
    bad = root / "Suturing" / "kinematics" / "AllGestures" / "Suturing_B001.txt"
    bad.write_bytes(bad.read_bytes()[:5000])
    code, said = skills("jigsaws", "add", str(root), "--json")
    one, other = json.loads(said)
    assert code == 1
    assert (one["recording"], "cells" in one["problems"][0]) == (None, True)
    assert (len(other["recording"]), other["problems"], other["demos"]) == (64, [], [])
    skills.refuses("recording", "add", str(root), says="skills jigsaws add")
    skills.refuses(
        "jigsaws", "add", str(root), "--task", "Knot_Tying", says="has trials of Suturing, not of Knot_Tying"
    )
    _, said = skills("jigsaws", "add", str(root))
    assert "Suturing_B001: " in said and "jigsaws-c" in said


def test_a_refusal_is_a_json_problem_for_programs_and_prose_for_people(skills, tmp_path: Path) -> None:
    def run(*words: str) -> tuple[int, str, str]:
        result = CliRunner().invoke(app, list(words))
        return result.exit_code, result.stdout, result.stderr

    code, out, err = run("surgeon", "show", "nobody", "--json")
    assert (code, out) == (1, "")
    problem = json.loads(err)
    assert (problem["type"], problem["status"]) == ("urn:suture-skills:not-found", 404)
    code, out, err = run("plan", *STYLE, "--point", "here", "--json")
    assert (code, out, json.loads(err)["type"]) == (1, "", "urn:suture-skills:bad-input")
    assert "3 numbers" in json.loads(err)["detail"]
    code, out, err = run("surgeon", "show", "nobody")
    assert (code, out, err.startswith("There is no surgeon 'nobody'.\n")) == (1, "", True)


def test_what_is_printed_for_programs_is_one_document_and_nothing_else(skills, tmp_path: Path) -> None:
    bag = tmp_path / "wren.mcap"
    bag.write_bytes(next(s for s in sample_recordings() if s.surgeon == "wren").data)
    for words in (
        ("migrate",),
        ("surgeon", "put", "wren", "--consent", "training", "--until", "2999-12-31"),
        ("surgeon", "list"),
        ("suture", "list"),
        ("recording", "add", str(bag)),
        ("demo", "add", str(bag), "--surgeon", "wren", "--suture", "simple-running", "--proposal", "1"),
        ("demo", "list"),
        ("job", "list"),
        ("policy", "list"),
        ("backup", str(tmp_path / "backup.zip")),
        ("restore", str(tmp_path / "backup.zip"), "--check"),
        ("erasures", str(tmp_path / "erasures.json")),
        ("verify",),
        ("erase", "wren", "--yes"),
    ):
        result = CliRunner().invoke(app, [*words, "--json"])
        assert result.exit_code == 0, (words, result.output)
        assert json.loads(result.stdout) is not None, words


def test_an_option_that_would_be_ignored_is_refused(skills, tmp_path: Path) -> None:
    """Before, the last day of a consent, a corrected time and the key of a history were dropped without a word."""
    file, binary = tmp_path / "hand-off.mcap", tmp_path / "binary"
    file.write_bytes(write_mcap(exports.session_of()))
    binary.write_bytes(b"\xff\xfe\x00")
    style = ("--surgeon", "wren", "--suture", "simple-running")
    for words, said in (
        (("surgeon", "put", "wren", "--until", "2030-12-31"), "--until is the last day of a consent"),
        (("score", str(file), *style, "--proposal", "0"), "hoose one with --proposal"),
        (("score", str(file), *style, "--proposal", "1", "--start-s", "0.5"), "not both"),
        (("verify", "--key", "abc+1+2"), "--key is about a replay bag"),
        (("verify", "--limit", "1"), "--limit is about --relearn"),
        (("verify", str(binary), "--relearn"), "are about the installation, not about a bag"),
        (("verify", "--head", str(binary)), "is not text in UTF-8"),
    ):
        code, printed = skills(*words)
        assert code == 1 and said in printed, (words, printed)


def test_the_table_of_a_folder_repeats_what_was_stated_exactly(skills, tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text("x_mm,y_mm,z_mm\n" + "".join(f"{n},{n},0\n" for n in range(40)))
    stated = tmp_path / "stated.toml"
    stated.write_text('["*.csv"]\nrate_hz = 29.9700299\ntable_arm = "PSM2"\nframe = "ECM"\n')
    code, printed = skills("recording", "table", str(tmp_path), "--stated", str(stated))
    assert code == 0 and "`--rate-hz 29.9700299` `--frame ECM` `--table-arm PSM2`" in printed, printed
