"""`make demo`: one style in this process by day, as a new user runs it at night."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console

from skills import demo
from skills.client import Client
from skills.settings import Settings
from skills.simulation import film
from tests import backends
from tests.api.service import serving
from tests.library.cases import working

SURGEONS = {"kestrel", "heron", "wren", "plover"}
FEW = {"kestrel"}  # the shortest path


@pytest.mark.needs("simulator")
def test_one_style_of_it_goes_all_the_way_in_this_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    every = demo.load_samples
    monkeypatch.setattr(demo, "load_samples", lambda client: [one for one in every(client) if one.surgeon in FEW][:1])
    monkeypatch.setattr(demo, "N_POINTS", 1)
    monkeypatch.setattr(demo, "running_service", served_here)
    monkeypatch.setattr(demo, "out", Console(highlight=False, width=160))
    monkeypatch.setattr(film, "FRAMES", 4)
    monkeypatch.setattr(film, "FRAMES_PER_PASS", 4)
    monkeypatch.setenv("SKILLS_SAMPLE_RECORDINGS", "")
    monkeypatch.chdir(tmp_path)
    assert demo.main() == 0
    agrees(capsys.readouterr().out, tmp_path / "build" / "demo", FEW, real=False)


@contextmanager
def served_here(folder: Path) -> Iterator[Client]:
    """Serve in this process, and carry out the jobs in a thread."""
    url = backends.place(folder / "skills.sqlite")
    with serving(url) as service, working(Settings(database_url=url)):
        yield Client(service.http)


@pytest.mark.nightly
@pytest.mark.needs("simulator")
@pytest.mark.parametrize("real", [False, pytest.param(True, marks=pytest.mark.needs("recordings"))])
def test_the_demo_does_the_main_job_and_exits_with_0(tmp_path: Path, real: bool) -> None:
    environment = (
        os.environ | {"COLUMNS": "160", "SKILLS_WORKERS": "1"} | ({} if real else {"SKILLS_SAMPLE_RECORDINGS": ""})
    )
    ended = subprocess.run([sys.executable, "-m", "skills.demo"], env=environment, cwd=tmp_path, capture_output=True)
    printed = ended.stdout.decode()
    assert ended.returncode == 0, printed + ended.stderr.decode()
    agrees(printed, tmp_path / "build" / "demo", SURGEONS, real)


def agrees(printed: str, pictures: Path, surgeons: set[str], real: bool) -> None:
    """Assert that the demo tells of every style, and that its pictures are there."""
    styles = re.findall(
        r"^ (\w+) [a-z-]+ +(\d+)/(\d+) +0 +[2-5]\d% +feasible; the complete plan succeeds in (\d+) of 1000 worlds",
        printed,
        re.MULTILINE,
    )
    assert {surgeon for surgeon, *_ in styles} == surgeons
    assert all(exact == states for _, exact, states, _ in styles)
    assert all(0 < int(worlds) < 1000 for *_, worlds in styles)  # a figure that is worth reading
    learnt = "333 of 333 states, DTW 0 mm, 57% of the demonstration from a start on average; released."
    assert (learnt if real else "No real recording:") in printed
    assert ("Played back at its own place: No hand-off: feasible in an exact simulation" in printed) == real
    assert len(list(pictures.glob("*-playback.png"))) >= len(styles)
    begins = {".png": b"\x89PNG", ".gif": b"GIF89a", ".mp4": b"\0\0\0"}
    assert all(picture.read_bytes().startswith(begins[picture.suffix]) for picture in pictures.iterdir())
    drawn = [
        f"kestrel-simple-running-{kind}" for kind in ("animation.mp4", "animation.gif", "joints.png", "clearance.png")
    ]
    assert f"The film of kestrel-simple-running and its plots over time: {', '.join(drawn)}" in printed
    assert all((pictures / name).is_file() for name in drawn)


STUBBORN = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(600)"


def test_a_service_that_does_not_end_is_killed_at_the_end_of_the_demo(monkeypatch: pytest.MonkeyPatch) -> None:
    """The service holds the demo's output open, so that a caller that reads it would wait for the service."""
    monkeypatch.setattr(demo, "END_S", 0.2)
    with subprocess.Popen([sys.executable, "-c", STUBBORN], stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        server.stdout.readline()
        demo.end(server)
        assert server.poll() == -signal.SIGKILL
