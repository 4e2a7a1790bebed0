"""Damaged and misassembled tables: refused with a message, or read as exactly their content.

A table has no checksum, so a changed digit cannot be noticed. What is read must be what the text says: a reader of a
few lines, `said`, is the judge.
"""

import csv
import io
import random
from collections import Counter
from collections.abc import Callable, Iterator
from decimal import Decimal
from typing import Any

import numpy as np
import pytest

from skills.demonstration.recording import Recording
from skills.errors import SkillsError
from skills.formats import read_recording
from skills.formats.cells import NS_PER
from skills.formats.parsed import parse
from tests.formats import hostile, written

QUICK, WHOLE = 20, 1500
MAPPED = {"column": ["x=PosX", "y=PosY", "z=PosZ"], "unit": ["mm"], "frame": "ECM"}
TIMED = "Time;" + written.positions().splitlines()[0] + ";Note\n"
TIMED += "".join(f"{10 * k};{row};n\n" for k, row in enumerate(written.positions().splitlines()[1:120]))
FILES: dict[str, tuple[str, dict[str, Any]]] = {
    "ee_csv": (written.ee_csv(rows=60), {"frame": "ECM"}),
    "ee_csv of numpy's texts": (written.ee_csv(rows=60, numpy=True), {"frame": "ECM"}),
    "ee_csv with joints": (written.ee_csv(rows=60, more=True), {"frame": "ECM"}),
    "mapped": (TIMED, {**MAPPED, "column": [*MAPPED["column"], "t_ms=Time"]}),
    "mapped with decimal commas": (
        TIMED.replace(".", ","),
        {**MAPPED, "column": [*MAPPED["column"], "t_ms=Time"], "decimal": "comma"},
    ),
    "joints": (written.joints(), {"rate_hz": 30.0, "instrument": "400006"}),
}
CELLS = (
    *(
        "",
        " ",
        "nan",
        "-inf",
        "1e999",
        "1e-999",
        "-0.0",
        "0x1p3",
        "1_0",
        "1,5",
        "1.5",
        "1.5,2",
        "1.2.3",
        "--1",
        "\0",
        "\u0661",
    ),
    *(
        "np.float64(nan)",
        "np.float64(1.0",
        "np.float64(np.float64(1.0))",
        "1" * 400,
        "1e400",
        '"',
        '""',
        '"1"',
        "True",
        "None",
    ),
    *("9" * 19, "9" * 25, "1760000000123456789", "-5", "1e308", "1e-99999999999999999999"),
)


def read(data: bytes, how: dict[str, Any]) -> Recording | str:
    """Read and describe a file; return its recording, or the class of its refusal. All other exceptions are errors."""
    try:
        recording = read_recording(io.BytesIO(data), **how)
        parse(recording)
    except SkillsError as refused:
        refused.message.encode()
        return type(refused).__name__
    return recording


def said(data: bytes, how: dict[str, Any], recording: Recording) -> dict[str, list[Any]]:
    """Return the numbers of the used columns as their cells say, by quantity; stamps in ns."""
    text = data.decode("utf-8-sig")
    head = text.splitlines()[0]
    rows = list(
        csv.reader(io.StringIO(text, newline=""), delimiter=";" if ";" in head else "," if "," in head else "\t")
    )[1:]
    found: dict[str, list[Any]] = {}
    for k, column in enumerate(recording.columns):
        if column.quantity:
            cells = [row[k].replace("np.float64(", "").rstrip(")") for row in rows if row]
            cells = [cell.replace(",", ".") for cell in cells] if how.get("decimal") else cells
            ns = NS_PER.get(column.unit)
            found[column.quantity] = (
                [round(Decimal(cell) * ns) for cell in cells] if ns else [float(cell) for cell in cells]
            )
    return found


def check_read_as_said(data: bytes, how: dict[str, Any], recording: Recording) -> None:
    """Check that every number is the one in the text, and that every sample is there or counted."""
    cells = said(data, how, recording)
    many = not any(name in cells for name in ("x", "q1"))  # the arms of an ee_csv; otherwise one without a name
    for motion in recording.motions:
        place = f"{motion.arm} {'local ' if motion.is_local else ''}" if many else ""
        stamps = np.array(cells["t"] if "t" in cells else np.rint(np.arange(len(cells["q1"])) * (1e9 / how["rate_hz"])))
        assert len(motion.stamps_ns) + motion.duplicate_stamps + motion.backward_stamps == len(stamps)
        latest = np.maximum.accumulate(stamps)
        kept = np.concatenate([[True], stamps[1:] > latest[:-1]])
        np.testing.assert_array_equal(motion.stamps_ns, stamps[kept])
        if f"{place}x" in cells:  # otherwise it follows from the joints
            tips = np.array([cells[f"{place}{axis}"] for axis in "xyz"]).T * (1000.0 if many else 1.0)
            np.testing.assert_array_equal(motion.tip_mm, tips[kept])
    for one in recording.joints:
        want = np.array([cells[f"{one.arm} q{k}" if many else f"q{k}"] for k in range(1, 7)]).T
        want[:, 2] *= 1000.0
        assert one.backward_stamps or np.array_equal(one.positions, want)


def sweep(name: str, files: Iterator[bytes]) -> Counter[str]:
    how = FILES[name][1]
    counts: Counter[str] = Counter()
    for data in files:
        found = read(data, how)
        if isinstance(found, Recording):
            check_read_as_said(data, how, found)
            assert data.endswith((b"\n", b"\r")) or found.notes  # its last number may be cut, which is said
        counts[found if isinstance(found, str) else "read"] += 1
    return counts


def mutations(text: str, count: int, seed: int) -> Iterator[bytes]:
    """Yield tables with one to three changes to cells, rows, columns or the header."""
    rng = random.Random(seed)
    separator = ";" if ";" in text.splitlines()[0] else ","
    for _ in range(count):
        rows = [line.split(separator) for line in text.splitlines()]
        for _ in range(rng.randint(1, 3)):
            rng.choice(_CHANGES)(rows, rng)
            rows[:] = [row or [""] for row in rows]  # an empty line is one empty cell
        end = rng.choice(("\n", "\n", "\r\n", "\r"))
        head, *others = (separator.join(row) for row in rows)
        first = rng.choice((end, end, end, "\r"))  # of the header, now and then another line end
        yield (head + first + end.join(others) + end).encode("utf-8", "surrogatepass")


Rows = list[list[str]]


def _cell(rows: Rows, rng: random.Random) -> None:
    row = rng.choice(rows[1:])
    row[rng.randrange(len(row))] = rng.choice(CELLS)


def _header(rows: Rows, rng: random.Random) -> None:
    head = rows[0]
    head[rng.randrange(len(head))] = rng.choice([*head, *CELLS, "t_s", "x_mm", "timestamp", "psm9_js[7]", "psm1_js[0]"])


def _drop_column(rows: Rows, rng: random.Random) -> None:
    k = rng.randrange(len(rows[0]))
    for row in rows:
        del row[k : k + 1]


def _swap_columns(rows: Rows, rng: random.Random) -> None:
    j, k = rng.randrange(len(rows[0])), rng.randrange(len(rows[0]))
    for row in rows:
        if max(j, k) < len(row):
            row[j], row[k] = row[k], row[j]


def _double_row(rows: Rows, rng: random.Random) -> None:
    k = rng.randrange(1, len(rows))
    rows.insert(k, list(rows[k]))


def _drop_row(rows: Rows, rng: random.Random) -> None:
    if len(rows) > 2:
        del rows[rng.randrange(1, len(rows))]


def _swap_rows(rows: Rows, rng: random.Random) -> None:
    j, k = rng.randrange(1, len(rows)), rng.randrange(1, len(rows))
    rows[j], rows[k] = rows[k], rows[j]


def _shorten_row(rows: Rows, rng: random.Random) -> None:
    row = rng.choice(rows)
    del row[rng.randrange(len(row)) :]


def _blank_row(rows: Rows, rng: random.Random) -> None:
    rows.insert(rng.randrange(len(rows) + 1), [""])


_CHANGES: list[Callable[[Rows, random.Random], None]] = [
    *[_cell] * 6, _header, _drop_column, _swap_columns, _double_row, _drop_row, _swap_rows, _shorten_row, _blank_row,
]  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_a_sound_table_is_read_as_it_says(name):
    assert sweep(name, iter([FILES[name][0].encode()])) == {"read": 1}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("count", [QUICK, pytest.param(WHOLE, marks=pytest.mark.nightly)])
def test_a_table_cut_anywhere_is_refused_or_read_as_its_rows_say(name, count):
    counts = sweep(name, hostile.truncations(FILES[name][0].encode(), count, seed=count))
    if name.startswith("ee_csv"):  # only a cut between two rows is not noticed
        assert counts["read"] <= 0.05 * count


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("count", [QUICK, pytest.param(WHOLE, marks=pytest.mark.nightly)])
def test_a_table_with_a_flipped_bit_is_refused_or_read_as_it_says(name, count):
    sweep(name, hostile.flips(FILES[name][0].encode(), count, seed=count))


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("count", [QUICK, pytest.param(WHOLE, marks=pytest.mark.nightly)])
def test_a_misassembled_table_is_refused_or_read_as_it_says(name, count):
    counts = sweep(name, mutations(FILES[name][0], count, seed=count))
    assert counts["read"] < 0.9 * count
