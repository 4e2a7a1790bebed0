"""Remedies of errors as data, and the table that words them for HTTP, the command line and Python.

    raise NotFound("There is no surgeon 'wren'.", Remedy(Action.ADD_SURGEON, surgeon="wren"))

The code that raises names the action and its values. Each interface chooses the words: the service those of HTTP, in
`skills.api.problems`; the commands theirs, in `skills.cli.commands`; Python, the client included, those of Python. A
remedy that reads the same for every interface is a plain sentence.
"""

import re
import shlex
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from difflib import get_close_matches
from enum import Enum
from string import Formatter
from typing import Any, NamedTuple, Self
from urllib.parse import quote

LEAST_PART = 4  # shortest input that suggests a name which contains it


class Words(NamedTuple):
    """A sentence for each interface; `{name}` is replaced by a value of the remedy."""

    http: str
    command: str
    python: str


class Action(Enum):
    """Actions that remedy an error, in the words of each interface."""

    ADD_SURGEON = Words(
        http="PUT /surgeons/{surgeon} adds one.",
        command="Add one: skills surgeon put {surgeon}",
        python="Add one: client.put_surgeon({surgeon})",
    )
    LIST_SURGEONS = Words(
        http="GET /surgeons lists them.",
        command="List them: skills surgeon list",
        python="List them: client.surgeons()",
    )
    LIST_SUTURES = Words(
        http="GET /suture-types lists them, and PUT /suture-types/{suture} adds one.",
        command="List them: skills suture list",
        python="List them: client.suture_types(), or add one: client.put_suture_type({suture}, name=..., family=...)",
    )
    LIST_DEMOS = Words(
        http="GET /demos lists them.",
        command="List them: skills demo list",
        python="List them: client.demos()",
    )
    LIST_DATASETS = Words(
        http="GET /jobs?kind=dataset lists the exports, and POST /datasets requests one.",
        command="Export one: skills export-dataset OUT.zip",
        python="List the exports: client.jobs(kind='dataset'), or request one: client.export_dataset(...)",
    )
    ADD_DEMO = Words(
        http="POST /demos?surgeon={surgeon}&suture={suture} adds one.",
        command="Add one: skills demo add FILE --surgeon {surgeon} --suture {suture}",
        python="Add one: client.add_demo(Path('FILE'), surgeon={surgeon}, suture={suture})",
    )
    NAME_PSM_M = Words(
        http="Give psm_m, with its approach and its base, or request a plan without a hand-off: handoff 'none'.",
        command="Give --approach and --base, or plan the tip's path alone: --no-handoff",
        python="Give psm_m, with its approach and its base, or plan the tip's path alone: handoff='none'",
    )
    EXPORT_A1_ALONE = Words(
        http="Request its bag with handoff=none, or plan again with psm_m.",
        command="Export it as such: --no-handoff, or plan again with --approach and --base",
        python="Request its bag with handoff='none', or plan again with psm_m",
    )
    NAME_TISSUE = Words(
        http="Plan again with tissue_mm, its height, or with a scene that has tissue.",
        command="Plan again with --tissue-mm, its height in mm, or with --obstacles, a file that has tissue",
        python="Plan again with tissue_mm, its height, or with a scene that has tissue",
    )
    NAME_SEGMENT = Words(
        http="Name one with segment=N, or take the whole recording with segment=whole.",
        command="Name one: --segment N, or take the whole recording: --segment whole",
        python="Name one: segment=N, or take the whole recording: segment='whole'",
    )
    LIST_PROPOSALS = Words(
        http="GET /proposals lists them.",
        command="List them: skills proposal list",
        python="List them: client.proposals()",
    )
    WITHDRAW_DEMO = Words(
        http="DELETE /demos/{demo} withdraws it.",
        command="Withdraw it: skills demo withdraw {demo}",
        python="Withdraw it: client.withdraw_demo({demo})",
    )
    MARK_DEMO = Words(
        http="PUT /demos/{demo}/outcome marks it as {outcome}.",
        command="Mark it: skills demo mark {demo} {outcome} --reason WHY",
        python="Mark it: client.mark_demo({demo}, {outcome}, reason=...)",
    )
    TRAIN_ANY = Words(
        http="Name another in demos, or learn from it all the same with outcomes 'any'.",
        command="Name another with --demo, or learn from it all the same: --outcomes any",
        python="Name another in demos, or learn from it all the same: client.train(..., outcomes='any')",
    )
    NAME_TOOL = Words(
        http="State it under `tools` in meta/suture-skills.json of the zip: PSM1 and its number.",
        command="State it: --tool PSM1=400006",
        python="State it: cut_episode(..., tools=dict(PSM1='400006')) of skills.formats.lerobot.cut",
    )
    NAME_FEATURES = Words(
        http="State their meanings under `columns` in meta/suture-skills.json of the zip.",
        command="State their meanings: --column psm1_pose.position.x=THEIRS, and so on",
        python="State their meanings: cut_episode(..., columns=...) of skills.formats.lerobot.cut",
    )
    CUT_EPISODE = Words(
        http="Send each episode as a zip of its own, with one .parquet file below data/.",
        command="Store one of them, or all: skills recording add DATASET --episode N, or --episode all",
        python="Cut them: cut_episode of skills.formats.lerobot.cut makes the file to send.",
    )
    ERASE_DEMOS = Words(
        http="It is deleted with the last of them: DELETE /demos/ID?erase=true.",
        command="It is deleted with the last of them: skills demo withdraw DEMO --erase",
        python="It is deleted with the last of them: client.withdraw_demo(demo, erase=True)",
    )
    ADD_RECORDING = Words(
        http="POST /recordings stores one.",
        command="Store it: skills recording add FILE",
        python="Store it: client.add_recording(Path('FILE'))",
    )
    LIST_JOBS = Words(
        http="GET /jobs lists them.",
        command="List them: skills job list",
        python="List them: client.jobs()",
    )
    SEE_JOB = Words(
        http="GET /jobs/{job} returns it.",
        command="See it: skills job show {job}",
        python="See it: client.job({job})",
    )
    TRAIN = Words(
        http="POST /trainings with release true learns it and releases it.",
        command="Learn and release it: skills train {surgeon} {suture} --release",
        python="Learn and release it: client.train({surgeon}, {suture}, release=True)",
    )
    RELEASE = Words(
        http="POST /policies/{surgeon}/{suture}/versions/{version}/release releases it.",
        command="Release it: skills policy release {surgeon} {suture} {version}",
        python="Release it: client.release({surgeon}, {suture}, {version})",
    )
    LIST_VERSIONS = Words(
        http="GET /policies/{surgeon}/{suture}/versions lists them; POST .../versions/N/release releases one.",
        command="List them: skills policy versions {surgeon} {suture}",
        python="List them: client.versions({surgeon}, {suture})",
    )
    MAKE_PLAN = Words(
        http="POST /plans makes one.",
        command="Make one: skills plan SURGEON SUTURE --point X,Y,Z",
        python="Make one: client.plan(surgeon, suture, [(x, y, z)])",
    )
    PLAY = Words(
        http="POST /playbacks with this plan plays it.",
        command="Play it: skills play {plan}",
        python="Play it: client.play({plan})",
    )
    ADD_PLAYBACK = Words(
        http="POST /playbacks requests one.",
        command="Play a plan: skills play PLAN",
        python="Play a plan: client.play(plan)",
    )
    DRAW = Words(
        http="POST /playbacks/{playback}/pictures requests them.",
        command="Draw them: skills play {plan} --pictures FOLDER",
        python="Draw them: client.wait(client.draw({playback}))",
    )
    JOIN_BAG = Words(
        http="Join the parts and send the bag as one MCAP file.",
        command="Join the parts first: skills recording add FOLDER",
        python="Join the parts first: skills.read_recording(FOLDER) does it.",
    )
    DECIMAL_COMMA = Words(
        http="Send it with decimal=comma.",
        command="Read it with decimal commas: --decimal comma",
        python="Read it with decimal commas: decimal='comma'",
    )
    NAME_COLUMNS = Words(
        http="Name each quantity's column with column=x_mm=NAME (docs/tables.md); the others are then not used.",
        command="Name each quantity's column: --column x_mm=NAME (docs/tables.md); the others are then not used.",
        python="Name each quantity's column: column=['x_mm=NAME', ...] (docs/tables.md); the others are then not used.",
    )
    NAME_UNIT = Words(
        http="Name it, such as unit={one} or unit={other}.",
        command="Name it, such as --unit {one} or --unit {other}",
        python="Name it, such as unit=[{one}] or unit=[{other}]",
    )
    DELETE_FIRST = Words(
        http="To have them read in another way, erase its demonstrations and DELETE /recordings/{recording} first.",
        command="Or erase its demonstrations with skills demo withdraw, and it: skills recording delete {recording}",
        python="Or erase its demonstrations, and it: client.delete_recording({recording})",
    )
    NAME_RATE = Words(
        http="Send it with rate_hz, or name the column of times: column=t_s=NAME, t_ms, t_us or t_ns.",
        command="Give --rate-hz, or name the column of times: --column t_s=NAME, t_ms, t_us or t_ns",
        python="Give rate_hz, or name the column of times: column=['t_s=NAME'], t_ms, t_us or t_ns",
    )
    NAME_FRAME = Words(
        http="Name it: frame=base if each arm's poses are in its own base, else the frame's name, such as frame=ECM.",
        command="Name it: --frame base if each arm's poses are in its own base, else its name, such as --frame ECM",
        python="Name it: frame='base' if each arm's poses are in its own base, else its name, such as frame='ECM'",
    )
    NAME_INSTRUMENT = Words(
        http="Name it: instrument={one} or instrument={other}.",
        command="Name it: --instrument {one} or --instrument {other}",
        python="Name it: instrument={one} or instrument={other}",
    )
    ADD_JIGSAWS = Words(
        http="Send each trial by itself.",
        command="Store all trials of the folder: skills jigsaws add {folder}",
        python="Store all trials of the folder: skills.samples.find_trials({folder}) and skills.samples.send_trials",
    )
    MIGRATE = Words(
        http="Ask the operator of the service to migrate its database.",
        command="Bring it to this version: skills migrate",
        python="Ask the operator of the service to migrate its database.",
    )
    START_WORKER = Words(
        http="Ask the operator of the service to start a worker and to check its log.",
        command="Start one and check its log: skills worker",
        python="Ask the operator of the service to start a worker and to check its log.",
    )
    LIST_KEYS = Words(
        http="GET /keys lists them.",
        command="List them: skills keys list",
        python="List them: client.keys()",
    )
    CREATE_ADMIN_KEY = Words(
        http="Ask the operator of the service for a key.",
        command="Make one: skills keys create OWNER --role admin",
        python="Ask the operator of the service for a key.",
    )
    SHOW_KEY = Words(
        http="Send the key as Authorization: Bearer KEY, or as X-API-Key.",
        command="Set SKILLS_API_KEY to a key of this service; its operator creates keys.",
        python="Give the key: Client(server, api_key=...); the operator of the service creates keys.",
    )
    PROTECT_KEY = Words(
        http="Use https://, or a tunnel to the service's machine.",
        command="Use https:// in SKILLS_SERVER, or a tunnel to the service's machine.",
        python="Use https://, or a tunnel; where the network itself is protected, plain_http=True sends the key.",
    )
    CALIBRATE = Words(
        http="Ask the operator of the service to calibrate it on rated trials.",
        command="Calibrate on rated trials: skills calibrate FOLDER",
        python="Ask the operator of the service to calibrate it on rated trials.",
    )
    ACCEPT_ROLLBACK = Words(
        http="Or ask the operator of the service to accept it: skills accept-rollback",
        command="Or go on with this one: skills accept-rollback",
        python="Or ask the operator of the service to accept it: skills accept-rollback",
    )
    VERIFY = Words(
        http="Ask the operator of the service to verify its database and to restore the row from a backup.",
        command="Find the row with skills verify, then restore it from a backup.",
        python="Ask the operator of the service to verify its database and to restore the row from a backup.",
    )
    LOAD_SAMPLES = Words(
        http="Ask the operator of the service to load the samples.",
        command="Load the samples: skills seed",
        python="Load the samples: skills.samples.load_samples(client)",
    )
    SEE_CALLS = Words(
        http="GET /openapi.json describes the calls.",
        command="See: skills --help",
        python="See: help(client)",
    )

    @property
    def slug(self) -> str:
        """Return the action's name in JSON."""
        return self.name.lower().replace("_", "-")

    @property
    def fields(self) -> frozenset[str]:
        """Return the names of the values in its words."""
        return frozenset(name for words in self.value for _, name, _, _ in Formatter().parse(words) if name)


class Door(Enum):
    """The interfaces, by the index of their words in `Words`."""

    HTTP = 0
    COMMAND = 1
    PYTHON = 2

    @property
    def written(self) -> Callable[[Any], str]:
        """Return the function that quotes a value for this interface, so that it stays one value."""
        return (lambda value: quote(str(value), safe=""), lambda value: shlex.quote(str(value)), repr)[self.value]


class Remedy:
    """An action with its values.

    Raises:
        TypeError: The values are not those that the action's words name.
    """

    def __init__(self, action: Action, **values: str | int) -> None:
        if set(values) != action.fields:
            raise TypeError(f"{action.name} takes {sorted(action.fields)}, not {sorted(values)}")
        self.action = action
        self.values = values

    def words(self, door: Door) -> str:
        """Return the remedy in the words of an interface."""
        words: str = self.action.value[door.value]
        said = words.format(**{name: door.written(value) for name, value in self.values.items()})
        # a command is copied and pasted, so it gets no full stop
        return said if door is Door.COMMAND or said.endswith(".") else f"{said}."

    def as_json(self) -> dict[str, str | int]:
        """Return the remedy as JSON data."""
        return {"action": self.action.slug, **self.values}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the remedy of JSON data.

        Raises:
            ValueError: This version does not know the action, or not with these values.
        """
        action = next((one for one in Action if one.slug == data.get("action")), None)
        values = {name: value for name, value in data.items() if name != "action"}
        if action is None or set(values) != action.fields or not all(isinstance(v, str | int) for v in values.values()):
            raise ValueError("unknown remedy")
        return cls(action, **values)

    def __eq__(self, other: object) -> bool:
        """Compare by action and values."""
        return isinstance(other, Remedy) and (self.action, self.values) == (other.action, other.values)

    def __hash__(self) -> int:
        """Hash by action and values."""
        return hash((self.action, *sorted(self.values.items())))

    def __repr__(self) -> str:
        """Return the action and the values."""
        return f"Remedy({self.action.name}, {self.values})"


def read_remedies(remedies: Iterable[str | Mapping[str, Any]]) -> list[Remedy | str]:
    """Return the remedies of a problem document; those that this version does not know are left out."""
    found: list[Remedy | str] = []
    for one in remedies:
        with suppress(ValueError):
            found.append(one if isinstance(one, str) else Remedy.from_json(one))
    return found


def did_you_mean(given: str, known: Iterable[str]) -> list[str]:
    """Return the known names most similar to an unknown one, as a list of one sentence or none."""
    names = list(known)
    plain = {_plain(name): name for name in reversed(names)}
    near = [plain[one] for one in get_close_matches(_plain(given), plain, n=3, cutoff=0.6)]
    if near and _plain(near[0]) == _plain(given):
        near = near[:1]
    near = near or [name for name in names if len(given) >= LEAST_PART and given in name][:3]
    if not near:
        return []
    return [f"Did you mean {' or '.join(repr(name) for name in near)}?"]


def _plain(name: str) -> str:
    """Return a name without the parts that are easily mistaken: case, and characters between words."""
    return re.sub(r"[-_. ]", "", name).lower()
