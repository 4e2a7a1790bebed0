"""Mistakes of a new user at the command line, each of which must be reported in plain words.

`python -m tests.mistakes` writes docs/mistakes.md again; `tests/test_mistakes.py` makes every mistake and compares.
"""

import gc
import logging
import os
import re
import shlex
import shutil
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from unittest.mock import patch

import uvicorn
from sqlalchemy import Engine, event
from typer.testing import CliRunner

from skills.api.app import create_app
from skills.cli import app
from skills.db.session import Database
from skills.library.operation.backup import back_up
from skills.library.people.keys import create_key
from skills.seeds.recordings import sample_recordings
from skills.settings import Settings, settings
from tests import backends
from tests.api import service
from tests.formats import trials
from tests.library import cases

PAGE = Path(__file__).parent.parent / "docs" / "mistakes.md"
STYLE = "kestrel simple-running"
ADD = "--surgeon kestrel --suture simple-running"
HEAD = """# Mistakes and their messages

Typical mistakes of a new user, the first line of the message, and the exit code: 1 if the command refuses, 2 if the
command line cannot be parsed. The lines after the first name the remedy. `tests/test_mistakes.py` makes every mistake
and compares the row; `python -m tests.mistakes` writes this page again.

| mistake | typed | first line | exit |
|---|---|---|---|
"""


@dataclass(frozen=True)
class Mistake:
    """A mistake: its description, the words after `skills`, the variables, and the surroundings that it needs."""

    what: str
    typed: str
    code: int = 1
    env: dict[str, str] = field(default_factory=dict)
    around: "Callable[[Path], Iterator[None]] | None" = None


@dataclass(frozen=True)
class Said:
    """The message, or else the output, with its variable parts replaced by words, and the exit code."""

    lines: list[str]
    code: int
    crashed: BaseException | None

    def row(self, mistake: Mistake) -> str:
        """Return the row of the page."""
        set_to = "".join(f"{name}={value} " for name, value in mistake.env.items())
        first = self.lines[0].replace("|", "\\|")
        return f"| {mistake.what} | `{set_to}skills {mistake.typed}` | {first} | {self.code} |"


def port_taken(folder: Path) -> Iterator[None]:
    """Listen at the requested port, and undo `serve`'s changes of this process."""
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind(("127.0.0.1", PORT))
        taken.listen()
        yield
    gc.enable()


def collecting(folder: Path) -> Iterator[None]:
    """Undo `serve`'s changes of this process."""
    yield
    gc.enable()


def without_learners(folder: Path) -> Iterator[None]:
    """Simulate an installation without the extra `deep`."""
    with patch("skills.deep.find_spec", return_value=None):
        yield


def without_pybullet(folder: Path) -> Iterator[None]:
    """Simulate an installation on a platform that has no wheel of PyBullet, for all processes that are started."""
    hidden = folder / "hidden"
    hidden.mkdir(exist_ok=True)
    (hidden / "sitecustomize.py").write_text("import sys; sys.modules['pybullet'] = None")
    paths = os.pathsep.join([str(hidden), *sys.path])
    with patch.dict(os.environ, PYTHONPATH=paths):
        yield


def full_disk(folder: Path) -> Iterator[None]:
    """Prevent the database from growing."""

    def limit(connection: Any, _record: object) -> None:
        connection.execute("PRAGMA max_page_count=1")  # SQLite raises this to the current number of pages

    event.listen(Engine, "connect", limit)
    with patch.object(logging.getLogger("skills.db.session"), "disabled", True):  # here the log is no file of its own
        yield
    event.remove(Engine, "connect", limit)


def other_database(folder: Path) -> Iterator[None]:
    """Write a database that another version has made."""
    url = backends.fresh("sqlite", folder)
    shutil.move(url.removeprefix("sqlite:///"), folder / "other.sqlite")
    import sqlite3

    with closing(sqlite3.connect(folder / "other.sqlite")) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
        connection.commit()
    yield


def good_backup(folder: Path) -> Iterator[None]:
    """Back the database up."""
    with closing(Database(f"sqlite:///{folder / 'skills.sqlite'}")) as database:
        back_up(database, folder / "good.zip")
    for left in folder.glob("skills.jobs.sqlite*"):  # of an earlier mistake; it would be refused first
        left.unlink()
    yield
    (folder / "good.zip").unlink()


def keyed_service(folder: Path) -> Iterator[None]:
    """Serve a database that has a key, so that every request needs one."""
    url = f"sqlite:///{shutil.copy(folder / 'skills.sqlite', folder / 'keyed.sqlite')}"
    with closing(Database(url)) as database, database.writing() as session:
        create_key(session, "anna", "reader", "local")
    served = create_app(Settings(database_url=url, port=PORT, workers=0))
    server = uvicorn.Server(uvicorn.Config(served, port=PORT, log_level="critical"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.02)
    try:
        yield
    finally:
        server.should_exit = True
        thread.join()


class _Stranger(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        """Answer as any web server does for a missing page."""
        self.send_error(404)

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""


def stranger(folder: Path) -> Iterator[None]:
    """Run a web server that is not this service."""
    with ThreadingHTTPServer(("127.0.0.1", PORT), _Stranger) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            thread.join()


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
        return port


PORT = _free_port()
HERE = "http://127.0.0.1:PORT"
MISTAKES = [
    # words and options
    Mistake("a misspelt command", "surgen list", 2),
    Mistake("a misspelt command of a group", "surgeon lst", 2),
    Mistake("a misspelt option", "demo list --surgon kestrel", 2),
    Mistake("a missing option", "demo add hand-off.csv --suture simple-running", 2),
    Mistake("a missing argument", "train kestrel", 2),
    Mistake("a misspelt choice", f"demo add hand-off.csv {ADD} --grid papr", 2),
    Mistake("a word where a number belongs", f"train {STYLE} --seed one", 2),
    Mistake("an unknown role", "keys create anna --role admn", 2),
    # recordings
    Mistake("a missing file", f"demo add nothing.mcap {ADD}"),
    Mistake("an empty file", f"demo add empty.mcap {ADD}"),
    Mistake("a PDF", f"demo add report.pdf {ADD}"),
    Mistake("a truncated recording", f"demo add truncated.mcap {ADD}"),
    Mistake("a folder without a recording", "recording add nothing-in-it"),
    Mistake("a folder of trials for a recording", "recording add jigsaws"),
    Mistake("a CSV with other columns", f"demo add columns.csv {ADD}"),
    Mistake("a CSV without times", f"demo add timeless.csv {ADD}"),
    Mistake("millimetres in columns of metres", f"demo add millimetres.csv {ADD}"),
    Mistake("a misspelt surgeon", "demo add hand-off.csv --surgeon kestral --suture simple-running"),
    Mistake("a misspelt suture type", "demo add hand-off.csv --surgeon kestrel --suture simple-runing"),
    Mistake("an unknown arm", f"demo add hand-off.csv {ADD} --arm PSM7"),
    Mistake("a misspelt arm", f"demo add real.mcap {ADD} --arm psm_2"),
    Mistake("a misspelt word for a segment", f"demo add hand-off.csv {ADD} --segment hole"),
    Mistake("another frame for bytes that are stored", "recording add hand-off.csv --frame PSM2_base"),
    Mistake("a negative cell size", f"demo add hand-off.csv {ADD} --cell-mm=-5 --grid fit"),
    Mistake("a cell size in metres", f"demo add hand-off.csv {ADD} --cell-mm 0.005 --grid fit"),
    Mistake("a hysteresis of cells", f"demo add hand-off.csv {ADD} --hysteresis 5"),
    Mistake("milliseconds for seconds", f"demo add hand-off.csv {ADD} --start-s 100 --end-s 400"),
    Mistake("an end before the start", f"demo add hand-off.csv {ADD} --start-s 0.4 --end-s 0.1"),
    Mistake("a trial's folder without trials", "jigsaws add nothing-in-it"),
    Mistake("a misspelt task", "jigsaws add jigsaws --task Sutring"),
    Mistake("a misspelt suture type for trials", "jigsaws add jigsaws --suture simple-runing"),
    Mistake("an arm of the dVRK for trials", "jigsaws add jigsaws --arm PSM1", 2),
    # surgeons, keys
    Mistake("a name for a pseudonym", "surgeon put 'Dr. Bob'"),
    Mistake("a misspelt level", "surgeon put wren --skill-level novise", 2),
    Mistake("a misspelt use in a consent", "surgeon put wren --consent trainig"),
    Mistake("an unknown surgeon", "surgeon show kestral"),
    Mistake("an erasure that is not confirmed", "erase kestrel"),
    Mistake("erasing a misspelt surgeon", "erase kestral --yes"),
    Mistake("an unknown key", "keys revoke 00000000"),
    # learning
    Mistake("a misspelt learner", f"train {STYLE} --learner dnq"),
    Mistake("a learner that is not installed", f"train {STYLE} --learner dqn", around=without_learners),
    Mistake("a release that the gate refuses", f"train {STYLE} --learner max-ent-irl --release"),
    Mistake("a setting without its learner", f"train {STYLE} --setting steps=10"),
    Mistake("a misspelt setting of a learner", f"train {STYLE} --learner dqn --setting stps=10"),
    Mistake("a setting without a value", f"train {STYLE} --learner dqn --setting steps"),
    Mistake("an invalid digest", f"train {STYLE} --demo newest"),
    Mistake("a style without a demonstration", "train wren simple-running"),
    Mistake("learning from a failure", "train linnet simple-running"),
    Mistake("a batch without a demonstration", "retrain --surgeon wren"),
    Mistake("an unknown job", "job show 0000000000000000"),
    # policies
    Mistake("a style that was never trained", "policy show wren simple-running"),
    Mistake("an unknown version", f"policy release {STYLE} 7"),
    Mistake("a file of an unknown kind", f"policy export {STYLE} policy.txt"),
    Mistake("a missing folder", f"policy export {STYLE} nowhere/policy.json"),
    Mistake("a folder that cannot be written to", f"policy export {STYLE} /proc/policy.json"),
    Mistake("a start outside of the grid", f"rollout {STYLE} --start=500,500,500"),
    Mistake("a start in metres", f"rollout {STYLE} --start=0.005,0.055,-0.125"),
    Mistake("a start of two numbers", f"rollout {STYLE} --start=5,55"),
    # plans
    Mistake("a plan without points", f"plan {STYLE}"),
    Mistake("points and a scene", f"plan {STYLE} --point 5,55,-125 --scene notes.txt"),
    Mistake("a suture point in metres", f"plan {STYLE} --point 0.005,0.055,-0.125"),
    Mistake("a suture point out of reach", f"plan {STYLE} --point 5,555,-120 --no-handoff"),
    Mistake("a plan without PSM_M, the arm that takes the needle", f"plan {STYLE} --point 5,55,-125"),
    Mistake("PSM_M in a plan without a hand-off", f"plan {STYLE} --point 5,55,-125 --approach=-1,0,0 --no-handoff"),
    Mistake("a suture point that is a word", f"plan {STYLE} --point here"),
    Mistake("a speed in metres", f"plan {STYLE} --point 5,55,-125 --speed-mm-s 0.02"),
    Mistake("a rate above the limit of robots", f"plan {STYLE} --point 5,55,-125 --rate-hz 1000"),
    Mistake("a scene that is not a recording", f"plan {STYLE} --scene notes.txt"),
    Mistake("an unknown plan", "play 01234567"),
    Mistake("a playback without PyBullet", "play PLAN", around=without_pybullet),
    Mistake("a bag of an unknown plan", "export 01234567 bag.zip"),
    Mistake("an unknown demonstration", "demo show 01234567"),
    Mistake("a misspelt suture type", "atlas simple-runing"),
    Mistake("a misspelt arm of a motion to score", f"score real.mcap {ADD} --arm PSM1"),
    Mistake("a score of a missing file", f"score nothing.csv {ADD}"),
    # the installation
    Mistake("a full disk", f"demo add another.mcap {ADD}", around=full_disk),
    Mistake("a misspelt task to calibrate on", "calibrate jigsaws --task suturing"),
    Mistake("a backup over a file that exists", "backup notes.txt"),
    Mistake("a backup to a folder that is not writable", "backup /proc/backup.zip"),
    Mistake("a file that is not a backup", "restore notes.txt --check"),
    Mistake("restoring a missing file", "restore nothing.zip --check"),
    Mistake("restoring over a database in use", "restore good.zip", around=good_backup),
    Mistake("a file that is not a bag", "verify notes.txt"),
    Mistake("a report to a folder that is not writable", "report --to /proc/report"),
    Mistake("a report to a file", "report --to notes.txt"),
    Mistake("a folder without rated trials", "calibrate nothing-in-it"),
    Mistake("too few permutations", "calibrate jigsaws --permutations 10"),
    # settings
    Mistake("a misspelt setting", "surgeon list", env={"SKILLS_DATBASE_URL": "sqlite:////data/skills.sqlite"}),
    Mistake("a port that is not a number", "surgeon list", env={"SKILLS_PORT": "eighty"}),
    Mistake("a limit with its unit", "surgeon list", env={"SKILLS_MAX_UPLOAD_BYTES": "256MB"}),
    Mistake("a misspelt level of the log", "surgeon list", env={"SKILLS_LOG_LEVEL": "warn"}),
    Mistake("a database that is not a URL", "surgeon list", env={"SKILLS_DATABASE_URL": "skills.sqlite"}),
    Mistake("a database in memory", "surgeon list", env={"SKILLS_DATABASE_URL": "sqlite://"}),
    Mistake("a database of another kind", "surgeon list", env={"SKILLS_DATABASE_URL": "mysql://me:secret@host/skills"}),
    Mistake("a database in a folder that cannot be created", "surgeon list", env={"SKILLS_DATABASE_URL": "sqlite:////proc/x/y"}),
    Mistake("a file that is not a database", "surgeon list", env={"SKILLS_DATABASE_URL": "sqlite:///notes.txt"}),
    Mistake("a folder for a database", "surgeon list", env={"SKILLS_DATABASE_URL": "sqlite:///nothing-in-it"}),
    Mistake(
        "a database of another version", "surgeon list",
        env={"SKILLS_DATABASE_URL": "sqlite:///other.sqlite"}, around=other_database,
    ),
    Mistake(
        "PostgreSQL that does not run", "surgeon list",
        env={"SKILLS_DATABASE_URL": "postgres://me:secret@127.0.0.1:1/skills"},
    ),
    Mistake("a server without its http://", "surgeon list", env={"SKILLS_SERVER": "localhost:8000"}),
    Mistake("a server that does not run", "surgeon list", env={"SKILLS_SERVER": "http://127.0.0.1:1"}),
    Mistake(
        "a key over plain HTTP", "surgeon list",
        env={"SKILLS_SERVER": "http://skills.invalid", "SKILLS_API_KEY": "skills_secret"},
    ),
    Mistake("a missing API key", "surgeon list", env={"SKILLS_SERVER": HERE}, around=keyed_service),
    Mistake(
        "a wrong key", "surgeon list",
        env={"SKILLS_SERVER": HERE, "SKILLS_API_KEY": f"skills_00000000_{'x' * 43}"}, around=keyed_service,
    ),
    Mistake(
        "a text that is not a key", "surgeon list",
        env={"SKILLS_SERVER": HERE, "SKILLS_API_KEY": "letmein"}, around=keyed_service,
    ),
    Mistake("the server of another program", "surgeon list", env={"SKILLS_SERVER": HERE}, around=stranger),
    Mistake("a port that is in use", "serve", env={"SKILLS_PORT": "PORT"}, around=port_taken),
    Mistake("every address without TLS", "serve", env={"SKILLS_HOST": "0.0.0.0"}, around=collecting),
    Mistake("a certificate without its key", "serve", env={"SKILLS_TLS_CERT": "cert.pem"}, around=collecting),
]  # fmt: skip


def fill(folder: Path) -> None:
    """Make the files that the mistakes name, next to a database with kestrel's released style."""
    url = service.copy_of_trained(folder)
    with service.serving(url) as installation:
        installation.client.put_surgeon("wren")
        installation.client.put_surgeon("linnet")
        failed = {"outcome": "failure", "outcome_reason": "The needle fell."}
        installation.client.add_demo(
            cases.hand_off((2.5, 0.0, 0.0)), surgeon="linnet", suture="simple-running", **failed
        )
        place = {"position_mm": (5.0, 55.0, -125.0)}
        plan = installation.client.plan("kestrel", "simple-running", [place], handoff="none", tissue_mm=-170.0)
        (folder / "plan.txt").write_text(plan["id"] if isinstance(plan, dict) else plan.id)
    sample = next(one for one in sample_recordings() if one.surgeon == "wren").data
    table = cases.hand_off()
    _, *rows = table.decode().splitlines()
    files = {
        "hand-off.csv": table,
        "real.mcap": sample,
        "another.mcap": next(one for one in sample_recordings() if one.surgeon == "heron").data,
        "empty.mcap": b"",
        "report.pdf": b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n1 0 obj\n<< /Type /Catalog >>\nendobj\n",
        "truncated.mcap": sample[: len(sample) // 3],
        "columns.csv": b"\n".join([b"time,a,b,c", *(row.encode() for row in rows)]),
        "timeless.csv": b"x_m,y_m,z_m\n0,0.05,-0.12\n0.01,0.05,-0.12\n0.02,0.05,-0.12\n",
        "millimetres.csv": b"t_s,x_m,y_m,z_m\n0,-30,25,-140\n0.1,-20,30,-130\n0.2,5,55,-125\n",
        "notes.txt": b"call the lab\n",
    }
    for name, data in files.items():
        (folder / name).write_bytes(data)
    (folder / "nothing-in-it").mkdir()
    trials.folder(folder / "jigsaws")


@contextmanager
def surroundings(mistake: Mistake, folder: Path) -> Iterator[None]:
    """Set the variables of a mistake and no other setting, and make its surroundings."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SKILLS_")}
    ours = {"SKILLS_DATABASE_URL": f"sqlite:///{folder / 'skills.sqlite'}", "COLUMNS": "200"}
    env = {name: value.replace("PORT", str(PORT)) for name, value in mistake.env.items()}
    before = Path.cwd()
    with ExitStack() as stack:
        stack.enter_context(patch.dict(os.environ, kept | ours | env, clear=True))
        if mistake.around is not None:
            stack.enter_context(contextmanager(mistake.around)(folder))
        os.chdir(folder)
        settings.cache_clear()
        try:
            yield
        finally:
            settings.cache_clear()
            os.chdir(before)


def make(mistake: Mistake, folder: Path) -> Said:
    """Make a mistake in this process."""
    with surroundings(mistake, folder):
        result = CliRunner().invoke(app, words_of(mistake, folder), input="")
    crashed = result.exception if not isinstance(result.exception, SystemExit) else None
    return Said(lasting(result.stderr or result.output, folder), result.exit_code, crashed)


def words_of(mistake: Mistake, folder: Path) -> list[str]:
    """Return the words of the command; PLAN stands for the digest of a plan."""
    plan = (folder / "plan.txt").read_text()
    return [plan if word == "PLAN" else word for word in shlex.split(mistake.typed)]


def lasting(said: str, folder: Path) -> list[str]:
    """Replace the parts that differ from run to run by words."""
    said = said.replace(str(folder), "FOLDER").replace(str(PORT), "PORT").replace(str(PORT + 1), "PORT+1")
    said = re.sub(r"in \d+\.\d s", "in 3.1 s", said)
    return [line for line in said.splitlines() if line.strip()]


def write_page() -> None:
    """Make every mistake, and write the page."""
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fill(folder)
        rows = []
        for mistake in MISTAKES:
            said = make(mistake, folder)
            rows.append(said.row(mistake))
            print(
                f"$ skills {mistake.typed}   # {mistake.what}",
                *said.lines,
                f"-> {said.code} {said.crashed or ''}",
                sep="\n",
            )
    PAGE.write_text(HEAD + "\n".join(rows) + "\n")


if __name__ == "__main__":
    write_page()
