"""Every block of code in README.md and docs/ is run by a test, and every page is on the documentation site.

`RUN_BY` names the test of each block, in the order of the page; a block that is not in it fails. The blocks without a
test of their own run here, on a real service that stands for the one of the page.
"""

import ast
import json
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import skills
from skills.cli import app
from skills.client import Client
from skills.formats import MEDIA_TYPES
from skills.schemas.pose_styles import PoseIn
from skills.schemas.recordings import StatedIn
from skills.seeds.recordings import Sample, sample_recordings
from skills.settings import PREFIX, Settings, settings
from tests.arms import ARMS
from tests.e2e.conftest import running
from tests.needs import need

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^    (?:skills|make|curl|python|export|[A-Z_]+=\S*) .*", re.MULTILINE)
HERE = "tests/test_docs.py::"
OF_ALL_PAGES = {"tests/test_docs.py", "tests/test_references.py"}
RUN = HERE + "test_the_blocks_of_a_page_run_in_its_order"
MEASURED = HERE + "test_the_parts_of_a_measurement_exist"  # minutes to hours: `make bench`, with data
ELSEWHERE = "programs and hardware of a laboratory: ROS, a simulator of others, a robot, another interpreter"
CLI, KEYS, OPERATING = "tests/test_cli_page.py::", "tests/test_keys_page.py::", "tests/test_operating_page.py::"
ALL_COMMANDS = "test_every_command_of_the_page_runs_in_the_order_of_the_page"
TABLES = "tests/test_tables_page.py::test_every_command_of_the_page_runs_and_prints_what_it_says"
RUNNER = "tests/test_running_page.py::test_the_runner_acts_as_the_service_in_every_state_and_phase"
SCENES = "tests/learning/test_in_scene.py::test_the_examples_of_the_page_run"
RUN_BY: dict[str, list[str]] = {
    "README.md": [HERE + "test_the_two_commands_of_the_readme_exist"],
    "atlas.md": [RUN, MEASURED],
    "cli.md": 18 * [CLI + "test_every_command_of_the_page_runs_and_prints_what_the_page_says"],
    "client.md": 13 * ["tests/test_client_page.py::test_every_block_of_the_page_runs_in_the_order_of_the_page"],
    "combining.md": 2 * [RUN],
    "contact.md": [RUN],
    "engineer.md": 7 * [RUN],
    "joining.md": [RUN],
    "execution.md": ["tests/library/test_arm_errors.py::test_the_servo_of_the_page_is_one"],
    "keys.md": 2 * [KEYS + ALL_COMMANDS]
    + 2 * [KEYS + "test_the_settings_of_the_page_are_those_there_are_with_these_defaults"],
    "lerobot.md": [
        RUN,
        TABLES,
        HERE + "test_the_statements_of_the_pages_are_accepted",
        RUN,
        "tests/formats/test_lerobot_writer.py::test_the_example_of_the_page_writes_a_dataset_that_is_read",
        "tests/test_cli.py::test_videos_of_the_users_own_dataset_are_exported_with_the_recordings",
        ELSEWHERE,
    ],
    "library.md": [HERE + "test_the_python_of_the_library_ends_with_a_feasible_playback"],
    "live.md": 2 * ["tests/live/test_check.py::test_a_stand_in_on_dds_is_checked_from_another_process"],
    "operating.md": 4 * [OPERATING + ALL_COMMANDS]
    + [OPERATING + "test_the_settings_of_the_page_are_those_there_are"]
    + 3 * [OPERATING + "test_the_units_of_the_page_are_units"]
    + [MEASURED],
    "policy-card.md": [RUN, "tests/api/test_cards.py::test_the_check_in_the_documents_finds_a_changed_card"],
    "pose-styles.md": [RUN, RUN, HERE + "test_the_statements_of_the_pages_are_accepted"],
    "recordings.md": [
        MEASURED,
        "tests/test_recordings_page.py::test_the_samples_are_understood_as_the_page_shows",
        HERE + "test_the_statements_of_the_pages_are_accepted",
    ],
    "replay.md": [
        *3 * [ELSEWHERE],
        RUN,
        "tests/api/test_guidance.py::test_the_loop_of_the_page_leads_an_unsteady_hand_to_the_hand_off",
    ],
    "results.md": 7 * [MEASURED],
    "running.md": [RUN, RUNNER],
    "scaling.md": [MEASURED],
    "scenes.md": [SCENES, SCENES, RUN],
    "scoring.md": 3 * [RUN],
    "tables.md": [*3 * [TABLES], "tests/test_references.py::test_every_call_of_a_page_exists", RUN, *2 * [TABLES]],
    "tutorial.md": 5 * ["tests/test_tutorial.py::test_every_command_of_the_tutorial_prints_its_transcript"],
}


def blocks(page: str) -> list[tuple[str, str]]:
    """Return the language and the text of every block of a page."""
    return BLOCK.findall((ROOT / ("" if page == "README.md" else "docs") / page).read_text())


@cache
def functions(file: str) -> set[str]:
    """Return the names of the functions at the top of a file of tests."""
    return {node.name for node in ast.parse((ROOT / file).read_text()).body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_of_a_page_is_run_by_a_test_that_is_named(page: Path) -> None:
    assert len(blocks(page.name)) == len(RUN_BY.get(page.name, [])), "name the test of each block in RUN_BY"
    for test in set(RUN_BY.get(page.name, [])) - {ELSEWHERE}:
        file, _, name = test.partition("::")
        assert name in functions(file), test
        assert file in OF_ALL_PAGES or page.stem in (ROOT / file).read_text(), f"{file} does not name the page"
    outside = BLOCK.sub("", page.read_text())
    assert INDENTED.findall(outside) == [], "write commands in a fenced block"


def test_the_two_commands_of_the_readme_exist() -> None:
    [(_, text)] = blocks("README.md")
    make, trying = (line.split()[:2] for line in text.splitlines())
    assert (make, trying) == (["make", "serve"], ["skills", "try"])
    assert "serve: $(SERVES)" in (ROOT / "Makefile").read_text()
    assert CliRunner().invoke(app, ["try", "--help"]).exit_code == 0


def test_the_parts_of_a_measurement_exist() -> None:
    """Measurements take minutes and data; here each command of one is compared with what can be measured."""
    makefile = (ROOT / "Makefile").read_text()
    parts = re.findall(r'^    "([\w-]+)": \w+,$', (ROOT / "tests/bench/__main__.py").read_text(), re.MULTILINE)
    for page, tests in RUN_BY.items():
        for (_, text), test in zip(blocks(page), tests, strict=True):
            for line in text.splitlines() if test == MEASURED else ():
                words = [
                    word for word in shlex.split(line, comments=True) if not word.startswith(("SKILLS_", "TESTS_"))
                ]
                if words[0] == "make":
                    assert re.search(rf"^{words[1]}:", makefile, re.MULTILINE), line
                    assert all(word[6:] in parts for word in words if word.startswith("PARTS=")), line
                elif words[0] != "skills":  # `tests/test_references.py` has its options
                    assert words[:2] == [".venv/bin/python", "-m"], line
                    assert (ROOT / f"{words[2].replace('.', '/')}.py").exists(), line


def test_the_statements_of_the_pages_are_accepted() -> None:
    [message] = [text for language, text in blocks("pose-styles.md") if language == "json"]
    PoseIn.model_validate_json(message)
    [stated] = [text for language, text in blocks("recordings.md") if language == "toml"]
    for statement in tomllib.loads(stated).values():
        StatedIn.model_validate(statement)
    [said] = [text for language, text in blocks("lerobot.md") if language == "json"]
    from tests.formats.lerobots import episode, packed  # here, because pyarrow is slow to import

    recording = skills.read_recording(packed(episode(said=json.loads(said))))
    assert [motion.frame for motion in recording.motions if motion.arm == "PSM1"] == ["ECM"]


def test_the_labels_of_the_surgeons_page_are_on_the_pages_of_the_service() -> None:
    """The steps themselves are done in a browser by `tests/e2e/test_page.py`, in six clicks."""
    pages = [*(ROOT / "skills/api/pages").rglob("*.*"), ROOT / "skills/library/plans/tries.py"]
    shown = "\n".join(page.read_text() for page in pages if page.suffix in (".html", ".js", ".py")).lower()
    page = (ROOT / "docs/surgeon.md").read_text()
    labels = [re.sub(r" (\d+|of 0.6 mm)$", "", label) for label in re.findall(r"(?<!\*)\*([A-Z][^*]+)\*", page)]
    assert len(labels) > 8
    assert [label for label in labels if label.lower() not in shown] == []


def test_the_media_type_of_every_recording_is_on_the_page_of_the_api() -> None:
    page = (ROOT / "docs/api.md").read_text()
    assert not [one for one in MEDIA_TYPES if f"`{one}`" not in page]


def test_every_setting_is_on_a_page() -> None:
    named = set(re.findall(rf"\b{PREFIX}([A-Z_]+)\b", "\n".join(page.read_text() for page in PAGES)))
    assert {name.upper() for name in Settings.model_fields} - named == set()


@pytest.mark.needs("simulator")
def test_the_python_of_the_library_ends_with_a_feasible_playback(capsys: pytest.CaptureFixture[str]) -> None:
    [(_, code)] = blocks("library.md")
    exec(compile(code, "library.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    assert "suboptimal=0" in printed[0]
    assert "starts_reaching=1331" in printed[0]
    assert printed[1] == "True None"
    assert "count=1000, of=1000" in printed[2]


# ---- the blocks without a test of their own, on a real service ---------------------------------------------------


class Reader:
    """A reader who types the blocks of a page into a shell, a terminal of Python or a file.

    Attributes:
        url: The service that stands for the one of the page.
        given: What stands for a placeholder such as `ID`; of a list each is given in turn.
        names: The names that the page's Python takes for granted, and those that it makes.
    """

    def __init__(self, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
        self.url, self.monkeypatch = url, monkeypatch
        self.given: dict[str, list[str]] = {}
        self.names: dict[str, Any] = {}

    def read(self, language: str, text: str) -> None:
        text = re.sub(r"http://127\.0\.0\.1:8000|(?<![\w/])localhost:8000", self.url, text)
        if language == "python":
            exec(compile(text, "a page", "exec"), self.names)
        elif language == "json":
            Path("arms.json").write_text(text)
        else:
            for line in text.splitlines():
                self.type(line)

    def type(self, line: str) -> None:
        typed = re.sub(r"[\[\]]", "", line) if "curl" not in line else line  # brackets: may be left out
        typed = typed.replace("$SKILLS_SERVER", self.url)
        words = [self.put(word) for word in shlex.split(typed, comments=True)]
        if words[0] == "export":
            self.monkeypatch.setenv(*words[1].split("=", 1))
            settings.cache_clear()
        elif words[0] == "curl":
            subprocess.run(["curl", "--fail-with-body", *words[1:]], check=True, stdout=subprocess.DEVNULL)
        else:
            assert words[0] == "skills", line
            result = CliRunner().invoke(app, words[1:], env={"COLUMNS": "160"})
            assert result.exit_code == 0, (line, result.output)
            if words[1] == "plan":
                self.given["PLAN"] = re.findall(r"^[0-9a-f]{64}\b", result.stdout, re.MULTILINE)

    def put(self, word: str) -> str:
        for name in sorted(self.given, key=len, reverse=True):
            if re.search(rf"\b{name}\b", word):
                values = self.given[name]
                value = values.pop(0) if len(values) > 1 else values[0]
                return re.sub(rf"\b{name}\b", value, word)
        return word


def sample(surgeon: str, passes: int = 1) -> Sample:
    return next(one for one in sample_recordings() if one.surgeon == surgeon and len(one.segments) == passes)


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Reader]:
    """Start a service with the samples and a released policy, and stand in a folder with the files of the pages."""
    need("simulator")
    need("curl")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SKILLS_API_KEY", raising=False)
    (tmp_path / "service").mkdir()
    with running(tmp_path / "service") as service, Client(service.url) as client:
        monkeypatch.setenv("SKILLS_SERVER", service.url)
        monkeypatch.setenv("SKILLS_DATABASE_URL", f"sqlite:///{service.database}")
        settings.cache_clear()
        made = Reader(service.url, monkeypatch)
        made.names["client"] = client
        assert CliRunner().invoke(app, ["seed"]).exit_code == 0
        client.wait(client.train("kestrel", "simple-running", release=True))
        Path("hand-off.mcap").write_bytes(sample("wren").data)
        yield made
    settings.cache_clear()


def combining(reader: Reader) -> None:
    start_s, end_s = sample("kestrel").segments[0]
    Path("kestrel.mcap").write_bytes(sample("kestrel").data)
    client, style = reader.names["client"], {"surgeon": "kestrel", "suture": "simple-running"}
    for cut_s in (0.1, 0.2):
        client.add_demo(Path("kestrel.mcap"), **style, start_s=start_s, end_s=end_s - cut_s)
    demos = [one.id for one in client.demos(**style)]
    reader.given["ID"] = [*demos, *demos, demos[0]]
    reader.names |= dict(zip(("one", "two", "three"), demos, strict=True))


def contact(reader: Reader) -> None:
    from skills.planning.handoff import PsmM

    need("mujoco")
    demo = cut("kestrel")
    policy = skills.learn_policy(
        skills.sparse_reward(skills.discretize(demo.tip_mm, skills.PAPER_GRID)), skills.PhaseQLearning(), seed=0
    )
    base = PsmM((-0.94, 0.10, -0.33), (160.0, 20.0, 20.0), (0.0, 0.0, 0.382683, 0.92388), base_from="stated")
    reader.names["plan"] = skills.stack(policy, [skills.SuturePoint((5.0, 55.0, -120.0))], demo=demo, psm_m=base)


def cut(surgeon: str) -> skills.Demo:
    recording = skills.read_recording(BytesIO(sample(surgeon).data))
    return skills.cut_demo(recording, start_s=sample(surgeon).segments[0][0], end_s=sample(surgeon).segments[0][1])


def pose_styles(reader: Reader) -> None:
    from skills.learning.tube_certificate import TubeLimits
    from tests.demonstration.test_partner import A, Kind, session
    from tests.demonstration.test_partner import cut as cut_session

    recording, _ = session(Kind(seed=4, passes=2))
    demo = cut_session(recording, f"/{A}/measured_cp")
    assert demo.rotation_xyzw is not None
    reader.names |= {
        **{"demos": [demo], "recordings": [recording], "TubeLimits": TubeLimits, "skills": skills},
        **{"start_mm": demo.tip_mm[0], "start_xyzw": demo.rotation_xyzw[0]},
        **{"goal_mm": demo.tip_mm[-1], "goal_xyzw": demo.rotation_xyzw[-1]},
        **{"tip_mm": demo.tip_mm[0], "rotation_xyzw": demo.rotation_xyzw[0]},
    }


def scoring(reader: Reader) -> None:
    from tests.library import rated

    client = reader.names["client"]
    for task in ("Knot_Tying", "Needle_Passing"):
        rated.folder(Path("rated"), task=task)
    Path("trial.mcap").write_bytes(sample("kestrel").data)
    demo = client.demos(surgeon="kestrel", suture="simple-running")[0].id
    reader.given |= {"DIGEST": [demo], "DIGEST-OR-FILE": [demo], "FOLDER": ["rated"]}


def atlas(reader: Reader) -> None:
    from skills.db.session import Database
    from tests.comparison.cohort import cohort
    from tests.library import cohorts

    cohorts.add_cohort(Database(settings().database_url), cohort(1, surgeons=2, sessions=3))
    reader.given["DIGEST"] = [reader.names["client"].demos(surgeon=cohorts.name(1))[0].recording]


def scenes(reader: Reader) -> None:
    from skills.gridworld.scene import Tissue

    level = skills.Scene(frame="PSM2_base", tissue=Tissue.plane((0.0, 0.0, -165.0), normal=(0.0, 0.0, 1.0)))
    Path("tissue.json").write_text(json.dumps(level.as_json()))


def lerobot(reader: Reader) -> None:
    from skills.formats.lerobot.writer import AboutDataset, ExportedEpisode, dataset_files
    from tests.formats import written

    client = reader.names["client"]
    recordings = [written.sample(one) for one in ("kestrel", "wren")]
    seen = [replace(one, motions=tuple(replace(motion, frame="ECM") for motion in one.motions)) for one in recordings]
    episodes = [ExportedEpisode(one, task="suture", split="train") for one in seen]
    about = AboutDataset("Sutures", arms=("PSM2",), fps=30, licence="CC-BY-4.0", consent="Export, until 2030.")
    for name, file in dataset_files(episodes, about, "v3.0"):
        (Path("sutures") / name).parent.mkdir(parents=True, exist_ok=True)
        (Path("sutures") / name).write_bytes(file.read())
    client.put_surgeon("kestrel", consent={"uses": ["training", "export"]})
    demos = [one.id for one in client.demos(surgeon="kestrel")]
    reader.given |= {
        "DATASET": ["sutures", "sutures", "sutures", "exported"],
        "PSM1": ["PSM2"],
        "DIGEST": [demos[0], demos[1]],
    }


def replay(reader: Reader) -> None:
    reader.names["client"].put_surgeon("robot")
    Path("replay.mcap").write_bytes(sample("kestrel").data)


def tables(reader: Reader) -> None:
    from tests.formats import written

    Path("hand-off.csv").write_text(written.positions())
    assert written.positions().startswith(blocks("tables.md")[0][1])
    reader.names["Path"] = Path


PREPARED = {one.__name__.replace("_", "-"): one for one in (atlas, combining, contact, lerobot, pose_styles, replay)}
PREPARED |= {one.__name__: one for one in (scenes, scoring, tables)}


@pytest.mark.nightly  # a service for each page
@pytest.mark.parametrize("page", [page for page, tests in RUN_BY.items() if RUN in tests])
def test_the_blocks_of_a_page_run_in_its_order(page: str, reader: Reader) -> None:
    prepare = PREPARED.get(page.removesuffix(".md"))
    if prepare is not None:
        prepare(reader)
    for (language, text), test in zip(blocks(page), RUN_BY[page], strict=True):
        if test == RUN:
            reader.read(language, text)
    if page == "engineer.md":
        assert reader.names["step"].done
        assert json.loads(Path("arms.json").read_text()).keys() == asdict(ARMS).keys()


# ---- the site ---------------------------------------------------------------------------------------------------


def paths(nav: object) -> Iterator[str]:
    """Yield the pages that a navigation names."""
    for one in nav if isinstance(nav, list) else nav.values() if isinstance(nav, dict) else ():
        yield from [one] if isinstance(one, str) else paths(one)


def gather(to: Path) -> None:
    runpy.run_path(str(ROOT / "docs/make_site.py"))["main"](to)


def test_every_page_is_on_the_site_and_lists_every_call_and_name(tmp_path: Path) -> None:
    gather(tmp_path)
    nav = tomllib.loads((ROOT / "zensical.toml").read_text())["project"]["nav"]
    assert sorted(paths(nav)) == sorted(page.name for page in tmp_path.glob("*.md"))
    api, library = (tmp_path / "api.md").read_text(), (tmp_path / "library.md").read_text()
    assert api.count("\n#### `") > 70
    assert [name for name in skills.__all__ if name != "__version__" and f".{name}\n" not in library] == []
    for page in tmp_path.glob("*.md"):
        for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", BLOCK.sub("", page.read_text())):
            assert (tmp_path / target).exists(), f"{page.name}: {target}"


@pytest.mark.nightly  # the pictures, and the pages as they are built, need half a minute
@pytest.mark.needs("site")
def test_the_site_has_no_dead_link_and_asks_no_other_host(tmp_path: Path) -> None:
    gather(tmp_path / "docs")
    told = (ROOT / "zensical.toml").read_text().replace('"build/', '"')
    (tmp_path / "zensical.toml").write_text(told.replace('paths = ["."]', f'paths = ["{ROOT}"]'))
    command = [sys.executable, "-m", "zensical", "build", "--strict", "-f", str(tmp_path / "zensical.toml")]
    subprocess.run(command, cwd=tmp_path, check=True)
    site = tmp_path / "site"
    texts = {page: page.read_text() for page in site.rglob("*.html")}
    anchors = {page: set(re.findall(r'\bid="([^"]+)"', text)) for page, text in texts.items()}
    assert len(texts) > 30
    for page, text in texts.items():
        assert re.findall(r'(?:src|rel="stylesheet" href)="(https?:[^"]+)"', text) == [], page.name
        for target, anchor in re.findall(r'href="(?!https?:|mailto:|data:)([^"#]*)(?:#([^"]*))?"', text):
            to = page if not target else site / target.lstrip("/") if page.name == "404.html" else page.parent / target
            assert to.exists(), f"{page.name}: {target}"
            assert not anchor or to.suffix != ".html" or anchor in anchors[to.resolve()], (
                f"{page.name}: {target}#{anchor}"
            )


@pytest.mark.nightly
def test_the_pictures_of_the_concepts_are_drawn_again(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "docs/draw.py", str(tmp_path)], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    drawn = sorted(tmp_path.glob("concept-*.png"))
    assert [one.name for one in drawn] == sorted(one.name for one in (ROOT / "docs").glob("concept-*.png"))
    for picture in drawn:
        assert same(picture, ROOT / "docs" / picture.name), picture.name


def same(one: Path, other: Path) -> bool:
    """Return whether two pictures differ in at most one of a thousand pixels, as fonts and rounding may."""
    import numpy as np
    from PIL import Image

    first, second = (np.asarray(Image.open(path).convert("L"), np.int64) for path in (one, other))
    return first.shape == second.shape and float((np.abs(first - second) > 32).mean()) <= 0.001
