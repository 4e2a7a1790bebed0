"""The text of a table as columns of numbers: separators, decimal marks and exact times.

    bytes --open_text, header_of--> names of the columns --read_numbers--> ParsedNumbers

Cells are separated by commas, semicolons or tabs; the header says by which. A decimal comma is only read where the
caller says so, because a comma in a number may as well group thousands. `np.float64(0.5)`, which some recorders write,
is 0.5. Times are converted from their text, because a float of nanoseconds since 1970 is only accurate to 240 ns.

A row of numbers never continues on a second line. Lines, columns and rows are limited in number and length, and each
limit is checked before the text is parsed.
"""

import csv
import io
import os
import re
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from decimal import Decimal
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, NamedTuple, TextIO

import numpy as np

from skills.arrays import Floats, Ints
from skills.errors import BadColumns, NotFinite, UnreadableRecording
from skills.remedies import Action, Remedy

if TYPE_CHECKING:
    from _csv import Reader

Decimals = Literal["point", "comma"]
LINE_CHARACTERS = 16_384  # a row of the widest supported table has 6,000
COLUMNS = 400  # the widest known recorder writes 180
ROWS = 5_000_000  # 14 hours at 100 Hz
BLOCK_BYTES = 1 << 20  # parsed at once; what is made of a larger block does not fit into the processor's cache
END_BYTES, END_ROWS = 1 << 16, 10  # ours: the rows with which the last one is compared
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
NS_PER = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}  # units of time
_PLACES = {ns: len(str(ns)) - 1 for ns in NS_PER.values()}  # decimals of a unit that are whole nanoseconds
_LATEST_S = 4_000_000_000  # the year 2096; larger values are in a smaller unit
_QUOTED = re.compile('"[^"]*"')
_NUMPY = re.compile(r"np\.float64\(([^(),;\t\n]*)\)")
_NUMPY_BYTES = re.compile(_NUMPY.pattern.encode())
_DECIMAL = r"^-?[0-9]{1,19}(\.[0-9]{0,9})?$"
_ISO = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](\d{1,9}))?\d*\s*(Z|[+-]\d\d:?\d\d)?")
_FIRST_ROW = 2  # the header is row 1


class TableLayout(NamedTuple):
    """How a table is written, and what of it is read.

    Attributes:
        names: The names of all columns.
        groups: The indices of the columns to read, in groups of at least one.
        separator: The character between two cells.
        decimal: The decimal mark.
        time: The index of the column with times, a group of its own, and its unit: one of `NS_PER`.
    """

    names: Sequence[str]
    groups: Sequence[Sequence[int]]
    separator: str = ","
    decimal: Decimals = "point"
    time: tuple[int, str] | None = None


@dataclass(frozen=True)
class ParsedNumbers:
    """The numbers of the columns that are used, and exact stamps, shape (T,), where one of them has times.

    Each group of columns is an array of its own, shape (T, columns), so that nothing needs to be copied out of others.
    """

    groups: Sequence[Floats]
    stamps_ns: Ints | None

    @property
    def rows(self) -> int:
        """The number of rows T."""
        return len(self.groups[0])


@contextmanager
def open_text(file: BinaryIO, verb: str = "Export") -> Iterator[TextIO]:
    """Yield the text of a table, and leave its file open; text that is no table is refused, with a verb to repair it.

    Raises:
        UnreadableRecording: It is not UTF-8, or not separated text.
    """
    text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
    try:
        yield text
    except (csv.Error, UnicodeDecodeError) as error:
        raise UnreadableRecording(f"The table is not comma-separated UTF-8 text: {error}. {verb} it again.") from error
    finally:
        text.detach()  # otherwise the wrapper would close the caller's file


def csv_rows(text: TextIO, *, first_line: int = 1, separator: str = ",") -> "Reader":
    """Return an iterator over rows, each from one line of at most `LINE_CHARACTERS` characters.

    A row of numbers never continues on a second line; with quoted cells that do, a row could be unlimited in length.
    Iterating raises `csv.Error`, and `UnreadableRecording` for a line that is longer or has an unclosed quoted cell.

    Args:
        text: Positioned at the first row.
        first_line: The number of the line at which `text` is positioned, for messages.
        separator: The character between two cells.
    """
    return csv.reader(_lines(text, first_line), strict=True, delimiter=separator)


def _lines(text: TextIO, number: int) -> Iterator[str]:
    """Yield the lines of a table; `number` is that of the first one. Raises as `csv_rows`."""
    while line := text.readline(LINE_CHARACTERS + 1):
        if len(line) > LINE_CHARACTERS:
            raise UnreadableRecording(
                f"Line {number} of the table has more than {LINE_CHARACTERS} characters; export the table again.",
                line=number,
            )
        if line.count('"') % 2:
            raise UnreadableRecording(
                f"The table is not comma-separated text: line {number} opens a quoted cell and does not close it. "
                "Export the table again.",
                line=number,
            )
        yield _NUMPY.sub(r"\1", line) if "np.float64(" in line else line
        number += 1


def has_separator(header: str) -> bool:
    """Return whether a header line has a separator, as that of a table does."""
    return any(one in header for one in SEPARATORS)


def separator_of(header: str) -> str:
    """Return the separator of a table, from its header line.

    Raises:
        BadColumns: The header has two kinds of separators.
    """
    found = [one for one in SEPARATORS if one in _QUOTED.sub("", header)]
    if len(found) > 1:
        kinds = " and ".join(SEPARATORS[one] for one in found)
        raise BadColumns(
            f"The header has both {kinds}; which of them separate the columns? Quote the names, or leave the others "
            "out of them."
        )
    return found[0] if found else ","


def header_of(text: TextIO) -> tuple[list[str], str]:
    """Read the header of a table; return the names of its columns, without spaces around them, and the separator.

    Raises:
        BadColumns: It has two kinds of separators, or too many columns.
    """
    line = next(_lines(text, 1), "")
    separator = separator_of(line)
    names = [name.strip() for name in next(csv.reader([line], strict=True, delimiter=separator), [])]
    if len(names) > COLUMNS:
        raise BadColumns(
            f"The table has {len(names)} columns, more than the limit of {COLUMNS}; keep those with the motion.",
            columns=len(names),
        )
    return names, separator


def ends_with_line(file: BinaryIO) -> bool:
    """Return whether the last row of a table has a line end; the position is at the beginning afterwards."""
    file.seek(-1, os.SEEK_END)
    last = file.read(1)
    file.seek(0)
    return last in (b"\n", b"\r")


def check_whole(file: BinaryIO) -> None:
    """Refuse a file that ends within a row, which would change its last number; for recorders that end every line.

    Raises:
        UnreadableRecording: Its last row has no line end.
    """
    if not ends_with_line(file):
        raise UnreadableRecording("The last row of the table has no line end: the file was cut. Copy it again.")


def check_last_number(file: BinaryIO, separator: str, decimal: Decimals) -> None:
    """Refuse a table without a last line end whose last number has lost decimals: all rows before agree on more.

    Compared are the rows in the last `END_BYTES`, if there are enough. The position is at the beginning afterwards.

    Raises:
        UnreadableRecording: It has.
    """
    file.seek(max(0, file.seek(0, os.SEEK_END) - END_BYTES))
    lines = file.read().decode(errors="replace").splitlines()[1:]  # the header, or a part of a row
    file.seek(0)
    mark = "," if decimal == "comma" else "."
    *others, last = [len(line.rpartition(separator)[2].strip().partition(mark)[2]) for line in lines] or [0]
    if len(others) >= END_ROWS and len(set(others)) == 1 and last < others[0]:
        raise UnreadableRecording(
            f"The last row of the table has no line end, and its last number has {last} decimals where all others have "
            f"{others[0]}: the file was cut. Copy it again, or delete the last row."
        )


def read_numbers(text: TextIO, layout: TableLayout) -> ParsedNumbers:
    """Read the rows of a table below its first line, which is the header.

    Args:
        text: The whole table, wherever it is positioned, as `open_text` opens it.
        layout: Its columns.

    Raises:
        UnreadableRecording: A row of another length, a cell that is not a number, too many rows, or none.
        NotFinite: A number is NaN or infinite.
        BadColumns: A time is beyond the year 2096.
    """
    # Typed as `TextIO`, but `open_text` makes it a wrapper of the file.
    numbers = _plain_numbers(text.buffer, layout)
    if numbers is None:
        text.seek(0)
        next(_lines(text, 1))  # the header
        numbers = _any_numbers(text, layout)
    _check_finite(layout, numbers.groups)
    if layout.time is not None and numbers.stamps_ns is not None and _mostly_repeated(numbers.stamps_ns):
        text.seek(0)
        next(_lines(text, 1))  # the header
        row = next(csv_rows(text, first_line=_FIRST_ROW, separator=layout.separator))
        _check_digits(layout.names, layout.time[0], row)
    if layout.time is not None:
        column, unit = layout.time
        _check_years(layout.names[column], unit, numbers.groups[list(layout.groups).index([column])][:, 0])
    return numbers


def _mostly_repeated(stamps_ns: Ints) -> bool:
    """Return whether more than half of the stamps repeat the one before."""
    return bool(2 * np.count_nonzero(stamps_ns[1:] == stamps_ns[:-1]) > len(stamps_ns))


def load_arrow() -> None:
    """Import Arrow, which the fast parser uses, before a process is forked for a table."""
    from pyarrow import compute  # noqa: F401


class _NotPlain(Exception):
    """Rows that `_any_numbers` reads or refuses."""


def _plain_numbers(file: BinaryIO, layout: TableLayout) -> ParsedNumbers | None:
    """Read a table whose rows are plain with Arrow's parser, in a tenth of the time; None for any other table.

    Arrow accepts no finite number that Python does not, and then the same one. Its reader of CSV files starts threads,
    which a reader's process may not; its conversion of texts does not. The rows are counted first, so that each number
    is stored once, where it stays: to map new memory takes as long as to parse.
    """
    from pyarrow import ArrowInvalid, compute, float64  # here, because most processes never need it

    names, groups, separator, decimal, time = layout
    columns, used = len(names), sorted({index for group in groups for index in group})
    place = {column: k for k, column in enumerate(used)}
    picks = [_as_slice([place[column] for column in group]) for group in groups]
    most = _most_rows(file, columns + len(used))
    found, stamps_ns, rows = [np.empty((most, len(group))) for group in groups], list[Ints](), 0
    try:
        for block in _plain_blocks(file, decimal):
            split, count = _cells(block, columns, separator)
            cells = split.take((2 * (np.arange(count)[:, None] * columns + used)).ravel())  # the others are separators
            if b" " in block or (separator != "\t" and b"\t" in block):
                cells = compute.ascii_trim_whitespace(cells)
            values = compute.cast(cells, float64()).to_numpy().reshape(-1, len(used))
            before, rows = rows, rows + len(values)
            if rows > most:
                return None
            for array, pick in zip(found, picks, strict=True):
                array[before:rows] = values[:, pick]
            if time is not None:
                stamps_ns.append(_stamps(cells[place[time[0]] :: len(used)], NS_PER[time[1]]))
    except (ArrowInvalid, ValueError, ArithmeticError, _NotPlain):  # the reason is found by `_any_numbers`
        return None
    if not rows:
        return None
    for array in found:
        array.resize((rows, array.shape[1]), refcheck=False)  # nothing else refers to it
    return ParsedNumbers(found, None if time is None else np.concatenate(stamps_ns))


def _as_slice(indices: list[int]) -> slice | list[int]:
    """Return indices as a slice, which copies nothing, where they follow one another."""
    run = slice(indices[0], indices[-1] + 1)
    return run if indices == list(range(run.start, run.stop)) else indices


def _most_rows(file: BinaryIO, least_bytes: int) -> int:
    """Return a bound on the rows: the number of lines, but no more than their least length and `ROWS` allow."""
    size, lines = file.seek(0, os.SEEK_END), 1
    file.seek(0)
    while block := file.read(BLOCK_BYTES):
        lines += block.count(b"\n")
    return min(lines, size // least_bytes + 1, ROWS)


def _plain_blocks(file: BinaryIO, decimal: Decimals) -> Iterator[bytes]:
    """Yield the rows below the header in blocks of whole lines, each ended by a newline alone.

    Raises:
        _NotPlain: There are quotes, lines without a newline, or points beside decimal commas.
        UnicodeDecodeError: They are not UTF-8.
    """
    file.seek(0)
    rest, is_header, is_last = b"", True, False
    while not is_last:
        read = file.read(BLOCK_BYTES)
        is_last = len(read) < BLOCK_BYTES
        whole, newline, rest = (rest + read, b"\n", b"") if is_last else (rest + read).rpartition(b"\n")
        block = whole + newline
        if b"\r" in block:  # one letter is found in a tenth of the time of two
            block = block.replace(b"\r\n", b"\n")
        if not newline or b"\r" in block:  # also in the header, below which a row would be lost
            raise _NotPlain
        if is_header:
            block, is_header = block.partition(b"\n")[2], False
        if is_last:  # it may end with empty lines, or without a line end
            block = block.rstrip(b"\n") + b"\n"
        if b'"' in block:
            raise _NotPlain
        if not block.isascii():
            block.decode()
        if b"(" in block:
            block = _NUMPY_BYTES.sub(rb"\1", block)
        if decimal == "comma":
            if b"." in block:
                raise _NotPlain
            block = block.replace(b",", b".")
        if not is_last or block != b"\n":
            yield block


def _cells(block: bytes, columns: int, separator: str) -> tuple[Any, int]:
    """Split rows at their separators; return Arrow's array of texts, every other one a separator, and the rows.

    Raises:
        _NotPlain: A row has another number of cells, or is too long.
    """
    from pyarrow import StringArray, py_buffer

    letters = np.frombuffer(block, np.uint8)
    is_newline = letters == ord("\n")
    ends = np.flatnonzero(is_newline | (letters == ord(separator))).astype(np.int32)
    rows, over = divmod(ends.size, columns)
    row_ends = ends[columns - 1 :: columns]
    if over or np.count_nonzero(is_newline) != rows or not is_newline[row_ends].all():
        raise _NotPlain
    if np.diff(row_ends, prepend=-1).max() >= LINE_CHARACTERS:
        raise _NotPlain
    offsets = np.zeros(2 * ends.size + 1, np.int32)
    offsets[1::2], offsets[2::2] = ends, ends + 1
    return StringArray.from_buffers(2 * ends.size, py_buffer(offsets), py_buffer(block)), rows


def _stamps(texts: Any, ns_per_unit: int) -> Ints:
    """Convert times to whole nanoseconds exactly, with Arrow's decimals where they are plain decimals themselves."""
    from pyarrow import ArrowInvalid, compute, decimal128

    try:
        if not compute.all(compute.match_substring_regex(texts, _DECIMAL)).as_py():  # a large exponent crashes Arrow
            raise _NotPlain
        decimals = compute.cast(texts, decimal128(38, _PLACES[ns_per_unit]))
    except (ArrowInvalid, _NotPlain):
        return np.fromiter((_exact_ns(text, ns_per_unit) for text in texts.to_pylist()), np.int64, len(texts))
    words: Ints = np.frombuffer(decimals.buffers()[1], np.int64).reshape(-1, 2)[: len(texts)]
    return np.minimum(words[:, 0], _LATEST_S * 1_000_000_000)  # `_check_years` refuses those that need both words


def _any_numbers(text: TextIO, layout: TableLayout) -> ParsedNumbers:
    """Read the rows one by one; arguments and errors are those of `read_numbers`."""
    names, groups, separator, decimal, time = layout
    used = [index for group in groups for index in group]
    rows = csv_rows(text, first_line=_FIRST_ROW, separator=separator)
    cells, stamps_ns, count, blank_line = array("d"), array("q"), 0, 0
    for row in rows:
        line = rows.line_num + 1
        if not row:
            blank_line = blank_line or line
            continue
        if count >= ROWS:
            raise UnreadableRecording(f"The table has more than {ROWS} rows; cut it into parts and send each part.")
        if blank_line or len(row) != len(names):
            line, found = blank_line or line, 0 if blank_line else len(row)
            raise UnreadableRecording(f"Row {line} has {found} cells, the header {len(names)}. Export the table again.")
        picked = [row[k] for k in used]
        if time is not None and (date := _ISO.fullmatch(picked[used.index(time[0])].strip())):
            with suppress(ValueError):  # such as 30 February, which is refused as no number below
                picked[used.index(time[0])] = _since_1970(date, NS_PER[time[1]])
        if decimal == "comma":
            picked = _with_points(names, used, picked, line)
        try:
            cells.extend(map(float, picked))
        except ValueError:
            raise _no_number(names, used, picked, line) from None
        if "_" in "".join(picked):  # Python parses 1_000, which no exporter writes
            raise _no_number(names, used, picked, line)
        if time is not None:
            stamps_ns.append(_exact_ns(picked[used.index(time[0])].strip(), NS_PER[time[1]]))
        count += 1
    if not count:
        raise UnreadableRecording("The table has a header and no rows.")
    values = np.frombuffer(cells).reshape(count, len(used))
    ends = np.cumsum([len(group) for group in groups])[:-1].tolist()
    return ParsedNumbers(
        [np.ascontiguousarray(part) for part in np.split(values, ends, axis=1)],
        None if time is None else np.frombuffer(stamps_ns, dtype=np.int64),
    )


def is_number(cell: str) -> bool:
    """Return whether a cell of a table is a number, in any form that an exporter writes."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell  # Python parses 1_000, which no exporter writes


def _with_points(names: Sequence[str], used: Sequence[int], cells: list[str], line: int) -> list[str]:
    """Return cells with points for decimal commas."""
    for k, cell in zip(used, cells, strict=True):
        if "." in cell or cell.count(",") > 1:
            raise UnreadableRecording(
                f"Row {line}, column {names[k]}: {cell[:40]!r} is not a number with a decimal comma; export the table "
                "with one decimal mark and without grouped thousands.",
                row=line,
                column=names[k],
            )
    return [cell.replace(",", ".") for cell in cells]


def _no_number(names: Sequence[str], used: Sequence[int], cells: list[str], line: int) -> UnreadableRecording:
    """Return the error for the first cell of a row that is no number."""
    k, cell = next((k, cell) for k, cell in zip(used, cells, strict=True) if not is_number(cell))
    where = f"Row {line}, column {names[k]}"
    if is_number(cell.replace(",", ".", 1)):
        return UnreadableRecording(
            f"{where}: {cell[:40]!r} has a comma; is it the decimal mark?",
            Remedy(Action.DECIMAL_COMMA),
            row=line,
            column=names[k],
        )
    return UnreadableRecording(f"{where}: not a number; export the table again.", row=line, column=names[k])


def _check_finite(layout: TableLayout, found: Sequence[Floats]) -> None:
    """Refuse NaN and infinity, naming the first row that has one."""
    wrong = list[tuple[int, int]]()
    for group, values in zip(layout.groups, found, strict=True):
        if not (finite := np.isfinite(values)).all():
            row, column = np.argwhere(~finite)[0].tolist()
            wrong.append((row + _FIRST_ROW, group[column]))
    if wrong:
        line, column = min(wrong)
        name = layout.names[column]
        raise NotFinite(f"Row {line}, column {name}: NaN or infinity; cut the row.", row=line, column=name)


def _since_1970(date: re.Match[str], ns_per_unit: int) -> str:
    """Return a date of ISO 8601 in a unit of time since 1970, exactly; without an offset it is in UTC.

    Raises:
        ValueError: There is no such date.
    """
    whole, part, zone = date.groups()
    moment = datetime.fromisoformat(whole + (zone or "+00:00"))
    since_ns = int(moment.timestamp()) * 1_000_000_000 + int((part or "").ljust(9, "0")[:9])
    return f"{Decimal(since_ns) / ns_per_unit:f}"


def _check_digits(names: Sequence[str], column: int, cells: list[str]) -> None:
    """Refuse times of the first row that lost their digits, such as 1.76E+09, because they would repeat.

    Raises:
        UnreadableRecording: A time of ten digits or more has fewer, and an exponent.
    """
    cell = cells[column].strip()
    mantissa, mark, exponent = cell.lower().partition("e")
    if mark and is_number(cell) and abs(float(exponent)) > sum(letter.isdigit() for letter in mantissa) - 1 >= 0:
        raise UnreadableRecording(
            f"Row {_FIRST_ROW}, column {names[column]}: {cell[:40]!r} has lost its last digits, in a spreadsheet or as "
            "a float. Export the times with all digits, as whole numbers or as text."
        )


def _exact_ns(cell: str, ns_per_unit: int) -> int:
    """Convert a time to whole nanoseconds exactly; 0 for one that `_check_years` or `_check_finite` refuses."""
    whole, _, part = cell.partition(".")
    if whole.isdecimal() and len(whole) < 20 and (not part or part.isdecimal()) and len(part) <= _PLACES[ns_per_unit]:
        stamp_ns = int(whole + part.ljust(_PLACES[ns_per_unit], "0"))  # ten times as fast as a Decimal
    else:
        time = float(cell)
        if time == 0 or not abs(time) < _LATEST_S * (1_000_000_000 // ns_per_unit):
            return 0
        stamp_ns = round(Decimal(cell) * ns_per_unit)
    return min(stamp_ns, _LATEST_S * 1_000_000_000)


def _check_years(name: str, unit: str, times: Floats) -> None:
    """Refuse times after the year 2096: they are in a smaller unit than the one that was named."""
    late = np.abs(times) >= _LATEST_S * (1_000_000_000 // NS_PER[unit])
    if late.any():
        row = int(np.argmax(late))
        words = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}[unit]
        raise BadColumns(
            f"Row {row + _FIRST_ROW}, column {name}: {times[row]:g} {unit} is after the year 2096; give {words}.",
            row=row + _FIRST_ROW,
        )
