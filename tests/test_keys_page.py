"""The examples of docs/keys.md run, and its statements are true."""

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import httpx2 as httpx
import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.cli.connecting import connect
from skills.library.people.keys import LADDER
from skills.settings import Settings, settings
from tests.api.service import copy_of_trained
from tests.e2e.conftest import Service
from tests.e2e.test_keys_served import wait_until_alive
from tests.waiting import END_S

PAGE = (Path(__file__).parent.parent / "docs" / "keys.md").read_text()
UNITS = {"GiB": 2**30, "": 1}


@pytest.fixture
def installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield an installation with two surgeons, as the commands find it."""
    monkeypatch.setenv("SKILLS_DATABASE_URL", copy_of_trained(tmp_path))
    monkeypatch.delenv("SKILLS_SERVER", raising=False)
    monkeypatch.delenv("SKILLS_API_KEY", raising=False)
    settings.cache_clear()
    with connect(settings()) as client:
        client.put_surgeon("heron")
    yield tmp_path
    settings.cache_clear()


def skills(*words: str) -> str:
    result = CliRunner().invoke(app, list(words))
    assert result.exit_code == 0, (words, result.output)
    return result.stdout


def test_every_command_of_the_page_runs_in_the_order_of_the_page(installation: Path):
    key_id, ran = "", []
    for command in "".join(re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)).splitlines():
        words = [word.replace("ID", key_id) if word == "ID" else word for word in shlex.split(command)]
        assert words[:2] == ["skills", "keys"], command
        said = skills(*words[1:])
        if words[2] == "create":
            key_id = said.split("_")[1]
        ran.append(words[2])
    assert ran == ["create", "create", "create", "list", "revoke"]
    listed = json.loads(skills("keys", "list", "--json"))
    assert [(one["owner"], one["role"], one["state"]) for one in listed] == [
        ("anna", "admin", "active"),
        ("robot cell 2", "reader", "active"),
        ("bob", "uploader", "revoked"),
    ]
    assert listed[2]["surgeons"] == ["heron", "kestrel"]
    table = skills("keys", "list")
    assert "heron, kestrel" in table
    assert "skills_" not in table


def test_what_cannot_be_done_says_so_and_exits_with_1(installation: Path):
    for words, why in (
        (("revoke", "00000000"), "skills keys list"),
        (("create", "local"), "An owner's name"),
        (("create", "bob", "--surgeon", "nobody"), "no surgeon 'nobody'"),
        (("create", "bob", "--role", "admin", "--surgeon", "heron"), "An admin key cannot be restricted"),
    ):
        result = CliRunner().invoke(app, ["keys", *words])
        assert (result.exit_code, why in result.output) == (1, True), result.output
    assert CliRunner().invoke(app, ["keys", "create", "bob", "--role", "god"]).exit_code == 2
    assert json.loads(skills("keys", "list", "--json")) == []


@pytest.mark.nightly  # by day tests/api and tests/e2e show keys to a service
def test_local_commands_need_no_key_and_send_theirs_to_a_server(installation: Path, monkeypatch: pytest.MonkeyPatch):
    made = json.loads(skills("keys", "create", "anna", "--role", "reader", "--json"))
    assert made["secret"].split("_")[1] == made["key"]
    with connect(settings()) as client:
        client.put_surgeon("wren")  # only an admin may
    service = Service(installation, workers=0)
    service.launch()
    assert service.process is not None
    try:
        with httpx.Client(base_url=service.url, timeout=END_S) as http:
            wait_until_alive(http, service.process)
        monkeypatch.setenv("SKILLS_SERVER", service.url)
        for key, status in (("", "401"), (made["secret"], None)):
            monkeypatch.setenv("SKILLS_API_KEY", key)
            settings.cache_clear()
            result = CliRunner().invoke(app, ["demo", "list", "--json"])
            assert (result.exit_code == 0) == (status is None), result.output
            assert made["secret"] not in result.output
    finally:
        service.stop()


def test_the_settings_of_the_page_are_those_there_are_with_these_defaults():
    names = {name.lower() for name in re.findall(r"SKILLS_([A-Z_]+)", PAGE)}
    assert len(names) > 14
    assert names <= set(Settings.model_fields)
    table = PAGE[PAGE.index("| setting | default |") :]
    for name, default in re.findall(r"\| `SKILLS_([A-Z_]+)` \| (\d+[^,|]*)", table):
        number, unit = re.findall(r"(\d+) ?(GiB)?", default)[0]
        assert Settings.model_fields[name.lower()].default == int(number) * UNITS[unit], name
    for block in re.findall(r"```ini\n(.*?)```", PAGE, re.DOTALL):
        given = {
            k.removeprefix("SKILLS_").lower(): v for k, _, v in (line.partition("=") for line in block.splitlines())
        }
        Settings(**given).check_address()


def test_the_roles_of_the_page_are_those_of_the_ladder():
    table = PAGE[PAGE.index("| role | may |") :]
    assert re.findall(r"^\| `([a-z]+)` \|", table, re.MULTILINE)[:5] == list(LADDER)
