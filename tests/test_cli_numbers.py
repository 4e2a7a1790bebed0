"""Numbers on the command line: none is nan or infinite, in any option of any command."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from skills.cli import app


def options(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any, str]]:
    """Yield each option with a value, with its command and the words that are typed for that."""
    if hasattr(command, "commands"):
        for name, part in command.commands.items():
            yield from options(part, (*path, name))
        return
    for one in command.params:
        if one.param_type_name == "option" and not one.is_flag:
            yield path, command, one.opts[0]


OF_NUMBERS = [
    (path, command, option)
    for path, command, option in options(get_command(app))
    if next(one.type_descriptor.annotation for one in command.params if option in one.opts) is float
    or option in ("--point", "--start", "--tissue-mm", "--base", "--approach", "--join", "--rotation-xyzw")
]


def typed(command: Any, file: Path) -> list[str]:
    """Return a word for each argument, and the options, that a command requires."""
    words = []
    for one in command.params:
        if one.required:
            value = {Path: str(file), int: "1"}.get(one.type_descriptor.annotation, "kestrel")
            words += [value] if one.param_type_name == "argument" else [one.opts[0], value]
    return words


def test_there_are_such_options() -> None:
    assert len(OF_NUMBERS) > 30
    assert {"--tissue-mm", "--speed-mm-s", "--start", "--point"} <= {option for _, _, option in OF_NUMBERS}


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e999"])
def test_no_option_takes_a_number_that_is_none(number: str, skills, tmp_path: Path) -> None:
    file = tmp_path / "hand-off.csv"
    file.write_text("t_s,x_mm\n0,1\n")
    for path, command, option in OF_NUMBERS:
        for value in (number, f"{number},0,0", f"0,0,{number}", f"0,{number},0,1"):
            said = CliRunner().invoke(app, [*path, *typed(command, file), f"{option}={value}"])
            assert said.exit_code in (1, 2), (path, option, said.output)
            assert isinstance(said.exception, SystemExit), (path, option, said.exception)
