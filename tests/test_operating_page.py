"""The examples of docs/operating.md run."""

import json
import os
import re
import shlex
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.db.session import Database
from skills.library.operation.history import sign_history
from skills.settings import Settings, settings
from tests.api.keyed import copy_of_told
from tests.api.service import copy_of_trained, serving
from tests.library.cases import wrong

DOCS = Path(__file__).parent.parent / "docs"
PAGE = (DOCS / "operating.md").read_text()
SQL = [one for page in sorted(DOCS.glob("*.md")) for one in re.findall(r"`(DELETE\s+FROM\s[^`]+)`", page.read_text())]
UNITS = [block for block in re.findall(r"```ini\n(.*?)```", PAGE, re.DOTALL) if "[Service]" in block]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield an installation with a released policy, as the commands find it."""
    monkeypatch.setenv("SKILLS_DATABASE_URL", copy_of_trained(tmp_path))
    monkeypatch.chdir(tmp_path)
    settings.cache_clear()
    yield tmp_path
    settings.cache_clear()


def test_every_command_of_the_page_runs_in_the_order_of_the_page(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands = "".join(re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)).splitlines()
    ran = []
    for command in commands:
        words = shlex.split(command)
        if words[0] == "export":
            name, _, value = words[1].partition("=")
            monkeypatch.setenv(name, value)
            settings.cache_clear()
            if name == "SKILLS_CHECKPOINTS":  # the service is started with it
                with closing(Database.of(settings())) as database:
                    sign_history(database)
            continue
        assert words[0] == "skills", command
        result = CliRunner().invoke(app, words[1:])
        assert result.exit_code == 0, (command, result.output)
        ran.append(words[1])
    assert {"backup", "restore", "erasures", "verify"} == set(ran)
    assert (folder / "elsewhere" / "skills.sqlite").stat().st_size > 100_000


@pytest.mark.parametrize("statements", SQL, ids=lambda text: text.split()[2])
def test_sql_of_the_documents_leaves_a_whole_installation(tmp_path: Path, statements: str) -> None:
    """Each is run as the sqlite3 program runs it, without enforced references, between two equal uses of all data."""
    with serving(copy_of_told(tmp_path)) as service:
        client, asked = service.client, {"surgeon": "kestrel", "suture": "simple-running"}
        recordings = [(one["id"], one["duration_s"] - 0.1) for one in client.recordings()]

        def used() -> list[object]:
            cuts = [client.cut_demo(one, **asked, start_s=0.1, end_s=end_s)["sha256"] for one, end_s in recordings]
            return [cuts, client.atlas("simple-running"), client.policy(**asked)]

        before = used()
        with sqlite3.connect(tmp_path / "skills.sqlite") as program:
            program.executescript(statements)
        program.close()
        assert wrong(service.database) == []
        assert used() == before
        assert wrong(service.database) == []


def test_restore_warns_without_a_list_and_refuses_beside_an_engine_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = CliRunner().invoke
    assert run(app, ["backup", "b.zip"]).exit_code == 0
    again = run(app, ["backup", "b.zip"])
    assert (again.exit_code, "never overwrites" in again.output) == (1, True)
    monkeypatch.setenv("SKILLS_DATABASE_URL", "sqlite:///new.sqlite")
    settings.cache_clear()
    Path("new.jobs.sqlite").touch()
    refused = run(app, ["restore", "b.zip"])
    assert (refused.exit_code, "another state" in refused.output) == (1, True)
    assert not Path("new.sqlite").exists()
    Path("new.jobs.sqlite").unlink()
    done = run(app, ["restore", "b.zip"])
    assert (done.exit_code, "NO LIST OF ERASURES" in done.output) == (0, True)
    refused = run(app, ["restore", "b.zip"])
    assert (refused.exit_code, "only into an empty one" in refused.output) == (1, True)
    missing = run(app, ["restore", "nowhere.zip", "--check"])
    assert (missing.exit_code, "No such file" in missing.output) == (1, True)


def test_commands_update_the_configured_list_and_a_restore_reads_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SKILLS_ERASURES_FILE", str(folder / "apart" / "erasures.json"))
    settings.cache_clear()
    run = CliRunner().invoke
    assert run(app, ["keys", "create", "anna"]).exit_code == 0
    key = json.loads(run(app, ["keys", "list", "--json"]).stdout)[0]["key"]
    assert run(app, ["backup", "b.zip"]).exit_code == 0
    assert run(app, ["keys", "revoke", key]).exit_code == 0
    assert run(app, ["policy", "withdraw", "kestrel", "simple-running"]).exit_code == 0
    monkeypatch.setenv("SKILLS_DATABASE_URL", "sqlite:///new.sqlite")
    settings.cache_clear()
    done = run(app, ["restore", "b.zip"])
    assert done.exit_code == 0, done.output
    assert "NO LIST" not in done.output
    assert "1 styles no longer served, 1 keys revoked" in done.output
    assert json.loads(run(app, ["keys", "list", "--json"]).stdout)[0]["state"] == "revoked"


def test_verify_writes_nothing(folder: Path) -> None:
    with sqlite3.connect("skills.sqlite") as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        before = connection.execute("PRAGMA data_version").fetchone()
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(Database, "writing", None)
            result = CliRunner().invoke(app, ["verify"])
        assert (result.exit_code, result.output.count("WRONG")) == (0, 0), result.output
        assert connection.execute("PRAGMA data_version").fetchone() == before
    connection.close()


def test_verify_exits_with_1_and_names_what_is_wrong(folder: Path) -> None:
    with sqlite3.connect("skills.sqlite") as connection:
        connection.execute("DROP TRIGGER policy_versions_append_only")
        connection.execute("UPDATE policy_versions SET manifest = replace(manifest, '\"seed\": 0', '\"seed\": 1')")
    result = CliRunner().invoke(app, ["verify"])
    assert (result.exit_code, "policy_versions 1: it differs from the certified policy" in result.output) == (1, True)
    assert '"wrong": 1' in CliRunner().invoke(app, ["verify", "--json"]).output


def test_the_settings_of_the_page_are_those_there_are() -> None:
    table = PAGE[PAGE.index("| setting | default |") :]
    names = re.findall(r"`([A-Z_]+)`", table[: table.index("\n\n")])
    names += [name.removeprefix("SKILLS_") for name in re.findall(r"SKILLS_[A-Z_]+", PAGE)]
    assert len(names) > 8
    assert {name.lower() for name in names} <= set(Settings.model_fields)


@pytest.mark.needs("systemd")
def test_the_units_of_the_page_are_units(tmp_path: Path) -> None:
    assert len(UNITS) == 3
    for name, unit in zip(
        ("suture-skills.service", "suture-skills-worker@.service", "backup.service"), UNITS, strict=True
    ):
        assert "MemoryDenyWriteExecute" not in unit
        assert "User=skills" in unit
        file = tmp_path / name
        file.write_text(unit.replace("/opt/suture-skills/.venv/bin/skills", sys.executable))
        checked = subprocess.run(
            ["systemd-analyze", "verify", "--man=no", str(file)], capture_output=True, text=True, env=dict(os.environ)
        )
        ours = [
            line for line in checked.stderr.splitlines() if name.split("@")[0] in line and "EnvironmentFile" not in line
        ]
        assert (checked.returncode, ours) == (0, []), checked.stderr
