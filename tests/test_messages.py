"""Messages in the words of their interface: none shows those of another one, a class name or a regular expression."""

import ast
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from typer.testing import CliRunner

import skills
from skills import errors
from skills.api.problems import answer_to
from skills.cli import app
from skills.client import Problem
from skills.client.blocking.client import Client
from skills.remedies import Action, Door, Remedy, did_you_mean, read_remedies
from skills.schemas.requests import describe
from skills.schemas.responses import Problem as ProblemDocument
from skills.seeds.recordings import sample_recordings
from skills.settings import settings
from tests import backends
from tests.library import cases

ROOT = Path(skills.__file__).parent
HTTP_WORDS = re.compile(r"\b(GET|PUT|POST|DELETE|PATCH) (/|\.\.\./)|Authorization|X-API-Key|openapi")
COMMAND_WORDS = re.compile(
    r"\bskills (add|show|surgeon|suture|demo|train|retrain|policy|plan|play|export|migrate|worker|seed|keys|calibrate"
    r"|verify|jigsaws|recording|job|serve|backup|restore|erasures|score|atlas)\b|SKILLS_API_KEY"
)
PYTHON_WORDS = re.compile(r"\bclient\.\w+|\bskills\.\w+\(|Client\(|\bhelp\(")
CLASS_NAMES = re.compile(r"\b(" + "|".join(name for name in vars(errors) if re.search("[a-z][A-Z]", name)) + r")\b")
REGULAR_EXPRESSION = re.compile(r"\[a-z|\[0-9|\\x00|\^\[|\]\{")
STRANGE = {
    Door.HTTP: (COMMAND_WORDS, PYTHON_WORDS, CLASS_NAMES, REGULAR_EXPRESSION),
    Door.COMMAND: (HTTP_WORDS, PYTHON_WORDS, CLASS_NAMES, REGULAR_EXPRESSION),
    Door.PYTHON: (HTTP_WORDS, COMMAND_WORDS, CLASS_NAMES, REGULAR_EXPRESSION),
}


def foreign(door: Door, text: str) -> list[str]:
    return [found[0] for pattern in STRANGE[door] if (found := pattern.search(text)) is not None]


@pytest.mark.parametrize("door", Door)
@pytest.mark.parametrize("action", Action)
def test_an_action_is_worded_by_every_door_in_its_own_words(action: Action, door: Door):
    remedy = Remedy(action, **dict.fromkeys(action.fields, "it"))
    words = remedy.words(door)
    assert words and "{" not in words
    assert foreign(door, words) == []
    assert read_remedies([remedy.as_json()]) == [remedy]


@cache
def calls() -> list[tuple[str, ast.Call]]:
    return [
        (f"{file.relative_to(ROOT)}:{node.lineno}", node)
        for file in sorted(ROOT.rglob("*.py"))
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call)
    ]


def called(node: ast.Call) -> str:
    return node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")


def test_every_remedy_in_the_source_has_the_values_that_its_words_name():
    seen = 0
    for where, node in calls():
        if called(node) == "Remedy" and isinstance(node.args[0], ast.Attribute):
            named = {one.arg for one in node.keywords}
            assert named == Action[node.args[0].attr].fields, where
            seen += 1
    assert seen > 20


def texts(node: ast.expr) -> Iterator[str]:
    for part in ast.walk(node):
        if isinstance(part, ast.Constant) and isinstance(part.value, str):
            yield part.value


def test_no_message_in_the_source_has_the_words_of_a_door():
    """Common messages and remedies have no words of an interface; the interfaces add their own."""
    kinds = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, Exception)}
    found = []
    seen = 0
    for where, node in calls():
        if called(node) not in kinds:
            continue
        seen += 1
        for argument in node.args:
            if isinstance(argument, ast.Call) and called(argument) == "Remedy":
                continue
            for text in texts(argument):
                patterns = (HTTP_WORDS, CLASS_NAMES, REGULAR_EXPRESSION)
                patterns += () if where.startswith("cli/") else (COMMAND_WORDS,)  # only commands raise these
                found += [(where, hit[0]) for pattern in patterns if (hit := pattern.search(text))]
    assert seen > 400
    assert found == []


def test_remedies_of_another_version_are_left_out_and_sentences_are_kept():
    said = ["Do it.", {"action": "fly"}, {"action": "add-surgeon"}, {"action": "list-demos"}]
    assert read_remedies(said) == ["Do it.", Remedy(Action.LIST_DEMOS)]
    with pytest.raises(TypeError):
        Remedy(Action.ADD_SURGEON, suture="wrong")


def test_a_value_stays_one_word_at_every_door():
    remedy = Remedy(Action.ADD_JIGSAWS, folder="a b'; rm -rf /")
    assert remedy.words(Door.COMMAND).endswith("""skills jigsaws add 'a b'"'"'; rm -rf /'""")
    assert Remedy(Action.ADD_SURGEON, surgeon="a/../b?c").words(Door.HTTP) == "PUT /surgeons/a%2F..%2Fb%3Fc adds one."


def test_an_error_is_worded_by_each_door():
    error = errors.NotFound("There is no surgeon 'wren'.", "Look.", Remedy(Action.ADD_SURGEON, surgeon="wren"))
    assert str(error) == "There is no surgeon 'wren'. Look. Add one: client.put_surgeon('wren')."
    assert error.words() == "There is no surgeon 'wren'. Look."
    said = json.loads(answer_to(error).body)
    assert said["detail"] == "There is no surgeon 'wren'. Look. PUT /surgeons/wren adds one."
    assert said["reason"] == "There is no surgeon 'wren'."
    assert said["remedies"] == ["Look.", {"action": "add-surgeon", "surgeon": "wren"}]
    assert str(Problem(ProblemDocument.model_validate(said))) == str(error)


def test_near_misses_are_suggested_and_others_are_not():
    assert did_you_mean("kestral", ["kestrel", "wren"]) == ["Did you mean 'kestrel'?"]
    assert did_you_mean("zebra", ["kestrel", "wren"]) == []
    assert did_you_mean("psm_1", ["PSM1", "PSM2", "MTMR"]) == ["Did you mean 'PSM1'?"]
    assert did_you_mean("Knot tying", ["Knot_Tying", "Suturing"]) == ["Did you mean 'Knot_Tying'?"]


def patterns_of(document: object) -> Iterator[str]:
    if isinstance(document, dict):
        yield from (value for name, value in document.items() if name == "pattern" and isinstance(value, str))
        for value in document.values():
            yield from patterns_of(value)
    elif isinstance(document, list):
        for value in document:
            yield from patterns_of(value)


@pytest.fixture
def door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Client]:
    """Yield the client of a separate service; the commands use the same database."""
    from skills.cli.connecting import connect

    monkeypatch.setenv("SKILLS_DATABASE_URL", backends.place(tmp_path / "skills.sqlite"))
    monkeypatch.delenv("SKILLS_SERVER", raising=False)
    settings.cache_clear()
    with connect(settings()) as client:
        yield client
    settings.cache_clear()


def test_every_form_of_a_text_in_a_request_has_its_words(door: Client):
    document = door.get_json("/openapi.json")
    asked = [
        document["paths"],
        *(model for name, model in document["components"]["schemas"].items() if name.endswith("In")),
    ]
    parameters = [
        one for calls in document["paths"].values() for call in calls.values() for one in call.get("parameters", ())
    ]
    found = set(patterns_of(parameters)) | set(patterns_of(asked[1:]))
    assert len(found) >= 5
    for pattern in found:
        assert re.fullmatch(r"\^\([\w|-]+\)\$", pattern) or describe(pattern)


def test_a_refusal_reads_in_the_words_of_service_client_and_command(door: Client):
    door.put_surgeon("kestrel")
    with pytest.raises(Problem) as refused:
        door.surgeon("kestral")
    said = str(refused.value)
    assert said == ("There is no surgeon 'kestral'. Did you mean 'kestrel'? Add one: client.put_surgeon('kestral').")
    assert "PUT /surgeons/kestral adds one." in refused.value.document.detail
    result = CliRunner().invoke(app, ["surgeon", "show", "kestral"])
    assert result.stderr.splitlines() == [
        "There is no surgeon 'kestral'.",
        "Did you mean 'kestrel'?",
        "Add one: skills surgeon put kestral",
    ]


def test_a_refused_argument_is_named_with_value_and_limit_at_each_door(door: Client):
    far = {"position_mm": (5, 55, 99_999)}
    with pytest.raises(Problem) as refused:
        door.plan("Kestrel", "simple-running", [far])
    assert str(refused.value).splitlines() == [
        "surgeon must be 1 to 64 lower-case letters, digits, - and _, and begin with a letter or a digit; "
        "'Kestrel' was given",
        "suture_points.0.position_mm.2 must be at most 10000; 99999 was given",
    ]
    assert "Kestrel" not in refused.value.document.model_dump_json()
    result = CliRunner().invoke(app, ["plan", "kestrel", "simple-running", "--point", "5,55,99999"])
    assert result.stderr.splitlines()[0] == "--point must be at most 10000; 99999 was given"
    with pytest.raises(Problem, match=r"has an unknown field \(did you mean 'speed_mm_s'\?\)"):
        door.plan("kestrel", "simple-running", [far], speed_mm=5)  # type: ignore[call-arg]


CALL = {"surgeon": "kestrel", "suture": "simple-running"}
PLACE = {"suture_points": [{"position_mm": [5, 55, -125]}]}


@pytest.mark.parametrize(
    ("path", "body", "where", "meant"),
    [
        ("/trainings", {**CALL, "relaese": True}, "body", "'release'"),
        ("/trainings", {**CALL, "learner": {"kind": "dqn", "stps": 5}}, "body.learner.dqn", "'steps'"),
        ("/trainings", {**CALL, "learner": {"kind": "dnq"}}, "body.learner", "'dqn'"),
        ("/trainings", {**CALL, "combine": {"kind": "medoit"}}, "body.combine.kind", "'medoid'"),
        ("/plans", {**CALL, "suture_points": [{"position": [5, 55, -125]}]}, "body.suture_points.0", "'position_mm'"),
        ("/plans", {**CALL, **PLACE, "psm_m": {"aproach": [0, 0, 1]}}, "body.psm_m", "'approach'"),
        ("/plans", {**CALL, **PLACE, "psm_m": {"instrument": "400-006"}}, "body.psm_m.instrument", "'400006'"),
        ("/plans", {**CALL, **PLACE, "psm_m": {"enters": "after-A1"}}, "body.psm_m.enters", "'after_A1'"),
    ],
)
def test_a_near_miss_in_a_body_is_suggested(door: Client, path: str, body: object, where: str, meant: str):
    said = door.http.post(path, json=body).json()
    whys = [one["why"] for one in said["errors"] if one["where"] == where]
    assert any(f"did you mean {meant}" in why for why in whys), said["errors"]


def test_a_near_miss_of_an_arm_is_suggested(door: Client):
    door.put_surgeon("kestrel")
    stored = door.add_recording(sample_recordings()[0].data)
    with pytest.raises(Problem) as refused:
        door.cut_demo(stored.sha256, **CALL, arm="psm_2", segment="whole")
    assert "no pose for arm psm_2" in str(refused.value) and "Did you mean 'PSM2'?" in str(refused.value)


@pytest.mark.parametrize(
    ("ask", "meant"),
    [
        (lambda door: door.plot("0" * 64, "joint"), "of must be one of joints, clearance. Did you mean 'joints'?"),
        (lambda door: door.animation("0" * 64, "MP4"), "kind must be one of mp4, gif. Did you mean 'mp4'?"),
    ],
)
def test_a_near_miss_of_an_argument_that_is_part_of_a_path_is_suggested(door: Client, ask, meant: str):
    with pytest.raises(errors.BadInput) as refused:
        ask(door)
    assert meant in str(refused.value)


def test_an_unknown_call_is_refused_in_the_words_of_each_door(door: Client):
    with pytest.raises(Problem) as refused:
        door.get_json("/nothing")
    assert foreign(Door.PYTHON, str(refused.value)) == []
    assert "help(client)" in str(refused.value)
    assert "openapi.json" in refused.value.document.detail


def test_how_bytes_were_read_is_told_in_words(door: Client):
    door.add_recording(cases.hand_off(), frame="PSM1_base")
    with pytest.raises(Problem, match="stored already, read with no rate_hz and frame PSM1_base"):
        door.add_recording(cases.hand_off())
