"""`make demo`: with one style, one suture point and no film by day, as a new user runs it at night."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from skills import demo

AS_IT_IS = ["-m", "skills.demo"]
SURGEONS = {"kestrel", "heron", "wren", "plover"}
FEW = {"kestrel"}  # the shortest path
SHORT = f"""
from skills import demo
every = demo.load_samples
demo.load_samples = lambda client: [one for one in every(client) if one.surgeon in {FEW}][:1]
demo.N_POINTS = 1
demo.save_film = lambda *_: None
raise SystemExit(demo.main())
"""


@pytest.mark.needs("simulator")
@pytest.mark.parametrize(
    ("how", "surgeons", "real"),
    [
        pytest.param(["-c", SHORT], FEW, False, id="short"),
        pytest.param(AS_IT_IS, SURGEONS, False, marks=pytest.mark.nightly, id="as it is"),
        pytest.param(
            AS_IT_IS, SURGEONS, True, marks=[pytest.mark.nightly, pytest.mark.needs("recordings")], id="a recording"
        ),
    ],
)
def test_the_demo_does_the_main_job_and_exits_with_0(
    tmp_path: Path, how: list[str], surgeons: set[str], real: bool
) -> None:
    environment = (
        os.environ | {"COLUMNS": "160", "SKILLS_WORKERS": "1"} | ({} if real else {"SKILLS_SAMPLE_RECORDINGS": ""})
    )
    ended = subprocess.run([sys.executable, *how], env=environment, cwd=tmp_path, capture_output=True)
    printed = ended.stdout.decode()
    assert ended.returncode == 0, printed + ended.stderr.decode()
    styles = re.findall(
        r"^ (\w+) [a-z-]+ +(\d+)/(\d+) +0 +[2-5]\d% +feasible, \d+ of 1000 worlds ", printed, re.MULTILINE
    )
    assert {surgeon for surgeon, _, _ in styles} == surgeons
    assert all(exact == states for _, exact, states in styles)
    pictures = tmp_path / "build" / "demo"
    learnt = "333 of 333 states, DTW 0 mm, 57% of the demonstration from a start on average; released."
    assert (learnt if real else "No real recording:") in printed
    assert ("Played back at its own place: No hand-off: feasible in an exact simulation" in printed) == real
    assert len(list(pictures.glob("*-playback.png"))) >= len(styles)
    begins = {".png": b"\x89PNG", ".gif": b"GIF89a", ".mp4": b"\0\0\0"}
    assert all(picture.read_bytes().startswith(begins[picture.suffix]) for picture in pictures.iterdir())
    if how is not AS_IT_IS:
        return
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
