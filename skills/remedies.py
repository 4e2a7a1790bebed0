"""Remedies of errors as data, and the table that words them for HTTP, the command line and Python.

    raise NotFound("There is no surgeon 'wren'.", Remedy(Action.ADD_SURGEON, surgeon="wren"))

The code that raises names the action and its values. Each interface chooses the words: the service those of HTTP, in
`skills.api.problems`; the commands theirs, in `skills.cli.commands`; Python, the client included, those of Python. A
remedy that reads the same for every interface is a plain sentence.
"""

import re
import shlex
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from difflib import get_close_matches
from enum import StrEnum
from pathlib import Path
from string import Formatter
from typing import Any, Self
from urllib.parse import quote

LEAST_PART = 4  # shortest input that suggests a name which contains it


class Door(StrEnum):
    """The interfaces that word a remedy."""

    HTTP = "http"
    COMMAND = "command"
    PYTHON = "python"

    def quoted(self, value: str | int) -> str:
        """Return a value as it is written at this interface, so that it stays one value."""
        if self is Door.PYTHON:
            return repr(value)
        return quote(str(value), safe="") if self is Door.HTTP else shlex.quote(str(value))


class Action(StrEnum):
    """Actions that remedy an error; `remedies.toml` has their words."""

    ADD_SURGEON = "add-surgeon"
    LIST_SURGEONS = "list-surgeons"
    LIST_SUTURES = "list-sutures"
    LIST_DEMOS = "list-demos"
    LIST_DATASETS = "list-datasets"
    ADD_DEMO = "add-demo"
    NAME_PSM_M = "name-psm-m"
    EXPORT_A1_ALONE = "export-a1-alone"
    NAME_TISSUE = "name-tissue"
    NAME_SEGMENT = "name-segment"
    LIST_PROPOSALS = "list-proposals"
    WITHDRAW_DEMO = "withdraw-demo"
    MARK_DEMO = "mark-demo"
    TRAIN_ANY = "train-any"
    NAME_TOOL = "name-tool"
    LEAVE_OUT_SURGEON = "leave-out-surgeon"
    NAME_FEATURES = "name-features"
    CUT_EPISODE = "cut-episode"
    ERASE_DEMOS = "erase-demos"
    ADD_RECORDING = "add-recording"
    LIST_JOBS = "list-jobs"
    SEE_JOB = "see-job"
    TRAIN = "train"
    RELEASE = "release"
    LIST_VERSIONS = "list-versions"
    MAKE_PLAN = "make-plan"
    PLAY = "play"
    ADD_PLAYBACK = "add-playback"
    DRAW = "draw"
    DECIMAL_COMMA = "decimal-comma"
    NAME_COLUMNS = "name-columns"
    NAME_UNIT = "name-unit"
    DELETE_FIRST = "delete-first"
    NAME_RATE = "name-rate"
    NAME_FRAME = "name-frame"
    NAME_INSTRUMENT = "name-instrument"
    ADD_JIGSAWS = "add-jigsaws"
    MIGRATE = "migrate"
    START_WORKER = "start-worker"
    LIST_KEYS = "list-keys"
    CREATE_ADMIN_KEY = "create-admin-key"
    SHOW_KEY = "show-key"
    PROTECT_KEY = "protect-key"
    CALIBRATE = "calibrate"
    ACCEPT_ROLLBACK = "accept-rollback"
    VERIFY = "verify"
    LOAD_SAMPLES = "load-samples"
    SEE_CALLS = "see-calls"

    @property
    def words(self) -> dict[Door, str]:
        """Return the sentence of each interface; `{name}` is replaced by a value of the remedy."""
        return WORDS[self]

    @property
    def fields(self) -> frozenset[str]:
        """Return the names of the values in its words."""
        return frozenset(name for words in self.words.values() for _, name, _, _ in Formatter().parse(words) if name)


# read with the module, because a confined process may open no file
WORDS = {
    Action(action): {Door(door): text for door, text in words.items()}
    for action, words in tomllib.loads(Path(__file__).with_name("remedies.toml").read_text()).items()
}


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
        text = self.action.words[door].format(**{name: door.quoted(value) for name, value in self.values.items()})
        # a command is copied and pasted, so it gets no full stop
        return text if door is Door.COMMAND or text.endswith(".") else f"{text}."

    def as_json(self) -> dict[str, str | int]:
        """Return the remedy as JSON data."""
        return {"action": self.action.value, **self.values}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the remedy of JSON data.

        Raises:
            ValueError: This version does not know the action, or not with these values.
        """
        values = {name: value for name, value in data.items() if name != "action"}
        try:
            return cls(Action(str(data.get("action"))), **values)
        except TypeError as error:
            raise ValueError("unknown remedy") from error

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
