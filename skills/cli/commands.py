"""Declaration of commands: registration, common arguments, flags from the keyword arguments of the client, and errors.

    @command(demos, "list")
    def demo_list(surgeon: OfSurgeon = None) -> Answer:
        with service() as client:
            return table(client.demos(surgeon), ("id", "surgeon"))

The section Args of the docstring has the help of the command's own parameters. One without a default is an argument,
any other an option, unless its annotation says otherwise.

A parameter whose type is one of `skills.keywords` stands for a flag for each of its fields that is a number, a
text or a choice, or a list of them, unless the command has a parameter of the field's name. Its value has the fields
that were given. The service checks them, so a limit is declared once.
"""

import errno
import inspect
import json
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import copy
from functools import partial, wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ForwardRef,
    Literal,
    NoReturn,
    Required,
    Union,
    get_args,
    get_origin,
    is_typeddict,
)

import typer
from typer.models import ArgumentInfo, OptionInfo

from skills.cli.completion import complete_surgeons, complete_sutures
from skills.cli.output import Answer, err, print_json
from skills.errors import BadInput, SkillsError, refuse_not_finite
from skills.remedies import Door, did_you_mean

if TYPE_CHECKING:
    from skills.transparency.signing_keys import PublicKey

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document; errors too, on stderr.")]
Surgeon = Annotated[str, typer.Argument(help="The surgeon's pseudonym.", autocompletion=complete_surgeons)]
Suture = Annotated[
    str, typer.Argument(help="The suture type, such as simple-running.", autocompletion=complete_sutures)
]
TheSurgeon = Annotated[str, typer.Option("--surgeon", help="The surgeon.", autocompletion=complete_surgeons)]
TheSuture = Annotated[str, typer.Option("--suture", help="The suture type.", autocompletion=complete_sutures)]
OfSurgeon = Annotated[
    str | None, typer.Option("--surgeon", help="Only of this surgeon.", autocompletion=complete_surgeons)
]
OfSuture = Annotated[
    str | None, typer.Option("--suture", help="Only of this suture type.", autocompletion=complete_sutures)
]
ToFile = Annotated[Path, typer.Argument(help="The file to write.", dir_okay=False)]
KEY = "The public key of the service that signed it, or a file with the key, as `skills public-key` prints it."
Key = Annotated[str, typer.Option(help=KEY)]
Triple = tuple[float, float, float]

COMPLETIONS = {"surgeon": complete_surgeons, "suture": complete_sutures}
# Options with another name than the argument of the client; the longer names first.
OPTIONS = {
    "suture_points": "point",
    "start_mm": "start",
    "demos": "demo",
    "without_surgeons": "without-surgeon",
    "surgeons": "surgeon",
    "sutures": "suture",
    "arms": "arm",
    "rotations_xyzw": "rotation-xyzw",
    "outcome_reason": "reason",
    "psm_m.base": "base",
    "psm_m.approach": "approach",
    "learner.": "setting",
}
ARGUMENT = re.compile(r"^ {4}(\w+): (.*(?:\n {8,}.*)*)", re.MULTILINE)  # of the section Args of a docstring
PARTS = re.compile(r"(?<=[.!?]) (?=[A-Z`'])|; |\n")  # separates the fault from the remedy


def command(
    group: typer.Typer, name: str | None = None, *, without: Collection[str] = ()
) -> Callable[[Callable[..., Answer | None]], Callable[..., None]]:
    """Register a function as a command, with the option --json if it returns an answer, which is then printed.

    An error is printed in one sentence, or as JSON, and the exit code is 1.

    Args:
        group: The group of the command.
        name: Its name; default: that of the function.
        without: Fields of keyword arguments for which it has no flag.
    """

    def register(function: Callable[..., Answer | None]) -> Callable[..., None]:
        signature = inspect.signature(function, eval_str=True)
        text, _, described = inspect.cleandoc(function.__doc__ or "").partition("\n\nArgs:\n")
        helps = {name: " ".join(words.split()) for name, words in ARGUMENT.findall(described)}
        parameters, flags = [_with_help(one, helps) for one in signature.parameters.values()], {}
        answers = signature.return_annotation is Answer
        asks_json = "as_json" in signature.parameters
        if answers and not asks_json:
            keyword = inspect.Parameter.KEYWORD_ONLY
            parameters.append(inspect.Parameter("as_json", keyword, default=False, annotation=AsJson))
        for one in signature.parameters.values():
            if is_typeddict(one.annotation):
                flags[one.name] = [*_flags(one.annotation, {*signature.parameters, *without})]
                place = [parameter.name for parameter in parameters].index(one.name)
                parameters[place : place + 1] = [flag for flag, _ in flags[one.name]]

        @wraps(function)
        def run(**values: Any) -> None:
            as_json = values["as_json"] if asks_json else values.pop("as_json", False)
            try:
                for keywords, of in flags.items():
                    given = {flag.name: (parse, values.pop(flag.name)) for flag, parse in of}
                    values[keywords] = {
                        field: parse(value) for field, (parse, value) in given.items() if value not in (None, [])
                    }
                refuse_not_finite(values, lambda path: _flag(next(one for one in path if one not in flags)))
                answer = function(**values)
                if answer is not None:
                    _print(answer, as_json)
            except SkillsError as error:
                _exit(error, run, as_json)
            except OSError as error:  # a path from the command line cannot be read or written
                where = "The file" if error.filename is None else str(error.filename)
                refused = BadInput(f"{where}: {error.strerror or error}.", *about_path(error))
                _exit(refused, run, as_json)
            except UnicodeDecodeError as error:
                _exit(BadInput(f"A file that was named is not text in UTF-8: {error}."), run, as_json)

        # options without a default need not be before those with one
        run.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in parameters]
        )
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        group.command(name, help=text)(run)
        return run

    return register


def _flag(name: str) -> str:
    """Return the option of a parameter."""
    return f"--{OPTIONS.get(name, name).replace('_', '-')}"


def _with_help(parameter: inspect.Parameter, helps: Mapping[str, str]) -> inspect.Parameter:
    """Return a parameter of a command with its help, where the docstring has it."""
    if parameter.name not in helps:
        return parameter
    kind: Any = parameter.annotation
    info: Any
    if get_origin(kind) is Annotated:
        kind, info = get_args(kind)
    elif parameter.default is parameter.empty:
        info = typer.Argument()
    else:  # a switch alone, where Typer would add its negation
        info = typer.Option(*[f"--{parameter.name.replace('_', '-')}"] * (kind is bool))
    info = copy(info)  # several commands may share it
    info.help = helps[parameter.name]
    return parameter.replace(annotation=Annotated[kind, info])


def _print(answer: Answer, as_json: bool) -> None:
    if as_json:
        print_json(answer.document)
    else:
        answer.show()
    if answer.refused is not None:
        raise answer.refused
    if answer.exit_code:
        raise typer.Exit(answer.exit_code)


# ---- flags -----------------------------------------------------------------------------------------------------------


def _flags(keywords: Any, declared: Collection[str]) -> Iterator[tuple[inspect.Parameter, Callable[[Any], Any]]]:
    """Yield the flag of each field of a TypedDict of keyword arguments, and the function that parses its value."""
    for name, annotation in keywords.__annotations__.items():
        kind, about = get_args(annotation)
        if isinstance(kind, ForwardRef) or name in declared:
            continue  # a value with fields of its own, for which the command has options
        option = OPTIONS.get(name, name).replace("_", "-")
        required = get_origin(kind) is Required
        is_several = get_origin(kind) in (Union, UnionType, Required)
        among = [one for one in get_args(kind) if one is not NoneType] if is_several else [kind]
        flag, parse = _flag_type(among)
        repeated = " Repeatable." if get_origin(flag) is list else ""
        switch = f"--{option}/--no-{option}" if kind == (bool | None) else f"--{option}"
        info = typer.Option(switch, help=about.documentation + repeated, autocompletion=COMPLETIONS.get(option))
        parameter = inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if required else None,
            annotation=Annotated[flag if required else flag | None, info],
        )
        yield parameter, parse


def _flag_type(among: Sequence[Any]) -> tuple[Any, Callable[[Any], Any]]:
    """Return the type of a flag as Typer knows it, and the function that parses its value.

    Args:
        among: The types of which its value is; several are a word or a number.
    """
    kind, *others = among
    parts = get_args(kind)
    if others:
        return str, PARSERS[parts[0]]
    if get_origin(kind) is tuple:
        return str, partial(numbers, count=len(parts))
    if get_origin(kind) is not Sequence:
        return kind, _same
    if get_origin(parts[0]) is tuple:
        count = len(get_args(parts[0]))
        return list[str], lambda texts: [numbers(text, count) for text in texts]
    return list[str], _same  # the service checks the words of a choice


def _same(value: Any) -> Any:
    return value


def parse_segment(text: str) -> Literal["whole"] | int:
    """Parse --segment: the number of a proposed hand-off, or whole.

    Raises:
        BadInput: It is neither.
    """
    if text == "whole":
        return "whole"
    if not text.isdecimal():
        raise BadInput(
            f"--segment {text!r} is neither the number of a proposed hand-off nor whole.",
            *did_you_mean(text, ["whole"]),
            "List the proposed hand-offs: skills recording add FILE",
        )
    return int(text)


def parse_tissue(text: str) -> float | Literal["none"]:
    """Parse --tissue-mm of a try: a height, or none.

    Raises:
        BadInput: It is neither.
    """
    if text == "none":
        return "none"
    try:
        return float(text)
    except ValueError:
        raise BadInput(
            f"--tissue-mm {text!r} is neither a height in mm nor none.", "Example: --tissue-mm=-165"
        ) from None


# Of a value that is a number or this word.
PARSERS: dict[str, Callable[[str], Any]] = {"whole": parse_segment, "none": parse_tissue}


def triple(text: str) -> Triple:
    """Parse x,y,z."""
    x, y, z = numbers(text, 3)
    return x, y, z


def numbers(text: str, count: int) -> list[float]:
    """Parse a number of values separated by commas.

    Raises:
        BadInput: The text does not have so many numbers.
    """
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count:
        raise BadInput(f"{text!r} is not {count} numbers separated by commas.", "Example: 1,2.5,-3")
    refuse_not_finite(found, lambda _: repr(text))
    return found


def read_json(path: Path, described: str, remedy: str) -> Any:
    """Return the JSON of a file.

    Raises:
        BadInput: It cannot be read, or is not JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise BadInput(f"The {described} {path} cannot be read as JSON: {error}.", remedy) from None


def read_key(key: str) -> "PublicKey":
    """Read a public key from the text of an option, or from the file that it names."""
    from skills.transparency.signing_keys import PublicKey

    return PublicKey.read(key if key.count("+") >= 2 and not Path(key).exists() else Path(key).read_text())


def on_terminal() -> bool:
    """Return whether a user can be prompted."""
    return sys.stdin.isatty()


# ---- errors ----------------------------------------------------------------------------------------------------------


def _exit(error: SkillsError, run: Callable[..., None], as_json: bool) -> NoReturn:
    """Print an error, the fault on one line and each remedy on one line; exit with 1."""
    fault, advice = _in_commands(error, run)
    if as_json:
        print(json.dumps(_problem(error, " ".join([fault, *advice])), default=str), file=sys.stderr)
    else:
        print_error(fault, advice)
    raise typer.Exit(1) from error


def print_error(fault: str, advice: Sequence[str]) -> None:
    """Print the fault in red on a line of its own, and the remedies below it."""
    err.print(fault, style="red", markup=False, soft_wrap=True)
    for line in advice:
        err.print(line, markup=False, soft_wrap=True)


def first_sentence(error: SkillsError) -> str:
    """Return the fault without its remedies."""
    return PARTS.split(error.message, maxsplit=1)[0]


def _in_commands(error: SkillsError, run: Callable[..., None]) -> tuple[str, list[str]]:
    """Return the fault and the remedies in the words of the command line.

    A message is "fault; remedy", or sentences of which the first is the fault.
    """
    from skills.client import Problem

    if isinstance(error, Problem) and error.refused:
        fault, *more = [one.sentence(_option(one.path, run)) for one in error.refused]
        return fault, [*more, *error.advice(Door.COMMAND), f"See the help: {_path(run)} --help"]
    fault, *more = PARTS.split(error.message, maxsplit=1)
    remedies = [one[:1].upper() + one[1:] for one in more]
    return fault + ("" if fault.endswith((".", "?", "!", ":")) else "."), [*remedies, *error.advice(Door.COMMAND)]


def _path(run: Callable[..., None]) -> str:
    """Return the words that are typed for a command."""
    from skills.cli import app

    def find(group: typer.Typer) -> list[str] | None:
        for one in group.registered_commands:
            if one.callback is run:
                return [one.name or str(getattr(run, "__name__", ""))]
        for part in group.registered_groups:
            found = None if part.typer_instance is None else find(part.typer_instance)
            if found is not None:
                return [*([str(part.name)] if part.name else []), *found]
        return None

    return " ".join(["skills", *(find(app) or [])])


def _option(path: Sequence[str], run: Callable[..., None]) -> str | None:
    """Return the name that a command has for an argument of the client; None if the names are equal."""
    renamed = next((option for given, option in OPTIONS.items() if ".".join(path).startswith(given)), None)
    parameters = inspect.signature(run).parameters
    found = parameters.get(path[0] if path else "") or parameters.get(renamed or "")
    if found is None:
        return None
    about = getattr(found.annotation, "__metadata__", ())
    if any(isinstance(one, ArgumentInfo) for one in about):
        return found.name.upper()
    # Typer keeps the first name of an annotated option as its default
    declared = [
        name for one in about if isinstance(one, OptionInfo) for name in (*(one.param_decls or ()), one.default)
    ]
    return next((name for name in declared if str(name).startswith("--")), f"--{found.name.replace('_', '-')}")


def about_path(error: OSError) -> list[str]:
    """Return advice about a path that cannot be used."""
    if isinstance(error, PermissionError):
        return ["Name a path that you may read and write, or change its permissions with chmod."]
    if isinstance(error, FileNotFoundError):
        return ["Check the spelling; a folder to write to must exist."]
    if isinstance(error, IsADirectoryError | NotADirectoryError | FileExistsError):
        return ["Name a file where a file is meant, and a folder where a folder is."]
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return ["The disk is full; make room, or name a path on another disk."]
    return []


def _problem(error: SkillsError, detail: str) -> dict[str, object]:
    """Return the problem document (RFC 9457) of an error: the service's own, or one for an error of this command."""
    from skills.client import Problem

    if isinstance(error, Problem):
        return error.document.model_copy(update={"detail": detail}).model_dump(mode="json", exclude_none=True)
    return {"type": f"urn:suture-skills:{error.kind}", "title": "Refused", "detail": detail, "numbers": error.numbers}
