"""Columns of untrusted Parquet files; the only importer of pyarrow, at the first such file.

The sizes that a file claims are checked before a column is read; types and lengths while it is read, in batches and in
this thread. Columns that are not used are not read. What remains, such as pages that are larger than they claim, meets
the memory limit of the reader's process.
"""

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Floats
from skills.errors import UnreadableRecording
from skills.formats.archive import FREE_BYTES, RATIO, printable, refusing

ROWS = 1_000_000  # nine hours at 30 Hz
FOOTER_BYTES = 16 << 20  # 2000 episodes of 50 columns in one file have 8 MB
LIST_ITEMS = 10_000  # of a list in the footer: row groups, columns, and elements of the schema, so also its depth
BATCH_ROWS = 65_536

_MAGIC = b"PAR1"
_WHAT, _ADVICE = "A Parquet file of the dataset", "Copy the dataset again."


@dataclass(frozen=True)
class ParquetColumn:
    """A column: `width` numbers or texts in every row."""

    name: str
    width: int = 1
    is_text: bool = False


@dataclass(frozen=True, eq=False)
class ParquetTable:
    """Columns of a file.

    Attributes:
        rows: The number of rows T.
        numbers: The numbers by column, shape (T, width), in single precision where the file has no more.
        texts: For each column and position the distinct texts.
    """

    rows: int
    numbers: dict[str, NDArray[np.floating]]
    texts: dict[str, list[set[str]]]

    def is_single(self, name: str) -> bool:
        """Return whether a column has numbers in single precision or less."""
        return name in self.numbers and self.numbers[name].dtype == np.float32

    def column(self, name: str) -> Floats | None:
        """Return a column of one number, shape (T,); None where there is none."""
        return self.numbers[name][:, 0].astype(np.float64) if name in self.numbers else None

    def stacked(self, places: Sequence[tuple[str, int]]) -> Floats:
        """Return some numbers of each row, named by column and position, shape (T, number of places)."""
        (name, first), end = places[0], places[-1][1] + 1
        if list(places) == [(name, k) for k in range(first, end)]:
            return self.numbers[name][:, first:end].astype(np.float64)
        return np.stack([self.numbers[name][:, k] for name, k in places], axis=1, dtype=np.float64)


def open_parquet(file: BinaryIO) -> Any:
    """Return a file as pyarrow's `ParquetFile`.

    Raises:
        UnreadableRecording: It is damaged, or its footer is too large.
    """
    from pyarrow import parquet  # here, because most processes never need it, and it takes 0.1 s

    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - 8))
    end = file.read(8)
    file.seek(0)
    head = file.read(len(_MAGIC))
    if head == _MAGIC != end[4:]:
        raise UnreadableRecording(
            f"{_WHAT} has no footer: its recorder was ended before it closed the file, or the copy ended early. "
            "Compare its size with the original's; the other episodes can be sent without it."
        )
    if end[4:] != _MAGIC or not 0 < int.from_bytes(end[:4], "little") <= min(FOOTER_BYTES, size):
        raise UnreadableRecording(f"{_WHAT} is truncated or corrupt. {_ADVICE}")
    file.seek(0)
    with refusing(_WHAT, _ADVICE):
        return parquet.ParquetFile(
            file,
            pre_buffer=False,  # it would start threads
            page_checksum_verification=True,
            thrift_string_size_limit=FOOTER_BYTES,
            thrift_container_size_limit=LIST_ITEMS,
        )


def read_columns(file: BinaryIO, columns: Sequence[ParquetColumn]) -> ParquetTable:
    """Read some columns of a file of at most `ROWS` rows.

    Args:
        file: The file, seekable.
        columns: At least one; a file without one of them is refused.

    Raises:
        UnreadableRecording: The file is damaged or claims too much; or a column is missing, of another type or length,
            or has gaps.
    """
    from pyarrow import types

    opened = open_parquet(file)
    rows = _checked_rows(opened, [one.name for one in columns], file.seek(0, os.SEEK_END))
    numbers: dict[str, NDArray[np.floating]] = {}
    texts: dict[str, list[set[str]]] = {one.name: [set() for _ in range(one.width)] for one in columns if one.is_text}
    at = 0
    with refusing(_WHAT, _ADVICE):
        for batch in opened.iter_batches(BATCH_ROWS, columns=[one.name for one in columns], use_threads=False):
            end = at + len(batch)
            if end > rows:
                raise UnreadableRecording(f"{_WHAT} has more rows than it claims. {_ADVICE}")
            for one in columns:
                values = _flat(batch.column(one.name), one)
                if one.is_text:
                    for position, found in enumerate(texts[one.name]):
                        found.update(values[position :: one.width].unique().to_pylist())
                else:
                    if one.name not in numbers:  # the type is that of the whole column
                        single = types.is_floating(values.type) and values.type.bit_width < 64
                        numbers[one.name] = np.empty((rows, one.width), np.float32 if single else np.float64)
                    numbers[one.name][at:end] = values.to_numpy(zero_copy_only=False).reshape(-1, one.width)
            at = end
    if at != rows:
        raise UnreadableRecording(f"{_WHAT} has {at} rows and claims {rows}. {_ADVICE}")
    return ParquetTable(rows, numbers, texts)


def read_rows(file: BinaryIO, names: Sequence[str], *, most_rows: int) -> list[dict[str, Any]]:
    """Read some columns of a table of at most `most_rows` rows as Python's values, of any type.

    Raises:
        UnreadableRecording: As for `read_columns`, but for the types and gaps of the values.
    """
    opened = open_parquet(file)
    _named_rows(opened, names, most_rows)
    # of whole row groups: in a damaged file pyarrow ends the process when it is asked about a column of one
    groups = (opened.metadata.row_group(group).total_byte_size for group in range(opened.metadata.num_row_groups))
    _check_plausible(sum(groups), 0, file.seek(0, os.SEEK_END))
    rows: list[dict[str, Any]] = []
    with refusing(_WHAT, _ADVICE):
        for batch in opened.iter_batches(BATCH_ROWS, columns=list(names), use_threads=False):
            rows += batch.select(list(names)).to_pylist()
            if len(rows) > most_rows:
                raise UnreadableRecording(f"{_WHAT} has more rows than it claims. {_ADVICE}")
    return rows


def _checked_rows(opened: Any, wanted: Collection[str], size: int) -> int:
    """Return the number of rows, if the memory that the columns take is plausible for the size of the file.

    Raises:
        UnreadableRecording: A column is missing or there twice, or they would take too much.
    """
    about = opened.metadata
    rows = _named_rows(opened, wanted, ROWS)
    # pyarrow reads everything below a dotted name: for `a` also the column `a.b`
    leaves = [k for k in range(about.num_columns) if _is_below(about.schema.column(k).path, wanted)]
    total = texts = 0
    for group in range(about.num_row_groups):
        chunks = about.row_group(group)
        for leaf in leaves:
            chunk = chunks.column(leaf)
            total += max(8 * chunk.num_values, chunk.total_uncompressed_size)
            texts += chunk.total_uncompressed_size if chunk.physical_type == "BYTE_ARRAY" else 0
    _check_plausible(total, texts, size)
    return rows


def _named_rows(opened: Any, wanted: Collection[str], most_rows: int) -> int:
    """Return the number of rows, if there are not too many, and each column is there once."""
    names = list(opened.schema_arrow.names)
    missing = [name for name in wanted if names.count(name) != 1]
    if missing:
        raise UnreadableRecording(f"{_WHAT} has the column {printable(missing[0])!r} {names.count(missing[0])} times.")
    rows = int(opened.metadata.num_rows)
    if rows > most_rows:
        raise UnreadableRecording(f"{_WHAT} has {rows} rows; at most {most_rows} are read. Cut it.")
    return rows


def _check_plausible(total: int, texts: int, size: int) -> None:
    """Refuse a file whose columns claim too much memory, all together or for texts."""
    if total > max(FREE_BYTES, RATIO * size) or texts > FREE_BYTES:
        raise UnreadableRecording(
            f"{_WHAT} declares {total} bytes unpacked from {size}, which is not plausible for a recording.",
            packed_bytes=size,
            unpacked_bytes=total,
        )


def _is_below(path: str, names: Collection[str]) -> bool:
    return any(path == name or path.startswith(f"{name}.") for name in names)


def _flat(values: Any, column: ParquetColumn) -> Any:
    """Return the values of a column of a batch, one after another, row by row.

    Raises:
        UnreadableRecording: It has another type or length, or gaps.
    """
    from pyarrow import types

    rows, kind, whole = len(values), values.type, column.width == 1
    if types.is_fixed_size_list(kind):
        whole = kind.list_size == column.width and not values.null_count
        values = values.flatten()
    elif types.is_list(kind) or types.is_large_list(kind):
        whole = not values.null_count and bool((np.diff(values.offsets.to_numpy()) == column.width).all())
        values = values.flatten()
    if column.is_text:
        typed = types.is_string(values.type) or types.is_large_string(values.type)
    else:
        typed = types.is_floating(values.type) or types.is_integer(values.type)
    if not whole or not typed or values.null_count or len(values) != rows * column.width:
        what = "texts" if column.is_text else "numbers"
        raise UnreadableRecording(
            f"{_WHAT}: the column {printable(column.name)!r} does not have {column.width} {what} in every row."
        )
    return values
