"""Tables as spreadsheets and libraries write them, made plain before they are read.

    UTF-16             the "Unicode text" of spreadsheets
    sep=;              a first line for spreadsheets, which names the separator
    # t_s,x_m,...      a header of numpy.savetxt
    1,2,3,             separators at the end of all rows, with or without one in the header

Nothing of this depends on the numbers.
"""

import codecs
import io
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from skills.errors import UnknownFormat
from skills.formats.cells import LINE_CHARACTERS, SEPARATORS

_SEP = re.compile(r'"?sep=(.?)"?\s*', re.IGNORECASE)
_COMMENT = re.compile(r"^#+[ \t]*")
UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


@contextmanager
def plain_table(file: BinaryIO) -> Iterator[BinaryIO]:
    """Yield a table without the peculiarities above: the file itself if it has none.

    Raises:
        UnknownFormat: It is not text in one encoding.
    """
    file.seek(0)
    head = file.read(4 * LINE_CHARACTERS)
    file.seek(0)
    is_utf16 = head.startswith(UTF16)
    lines = head.decode("utf-16" if is_utf16 else "utf-8-sig", "replace").splitlines()[:3]
    is_marked = bool(lines) and _SEP.fullmatch(lines[0]) is not None
    header, row = (*lines[is_marked:], "", "")[:2]
    closing = next((one for one in SEPARATORS if _closes(header, row, one)), "")
    if not (is_utf16 or is_marked or header.startswith("#") or closing):
        yield file
        return
    with tempfile.TemporaryFile() as out:
        text = io.TextIOWrapper(file, encoding="utf-16" if is_utf16 else "utf-8-sig", newline="", errors="strict")
        try:
            _rewrite(text, out, is_marked=is_marked, closing=closing)
        except UnicodeDecodeError as error:
            raise UnknownFormat(f"The table is not text in one encoding: {error}. Save it as UTF-8.") from error
        finally:
            text.detach()
        out.seek(0)
        yield out


def _closes(header: str, row: str, separator: str) -> bool:
    """Return whether rows end with a separator that begins no column."""
    cells = header.rstrip(separator).count(separator) + 1
    return cells > 1 and row.endswith(separator) and row.count(separator) == cells


def _rewrite(text: io.TextIOWrapper, out: BinaryIO, *, is_marked: bool, closing: str) -> None:
    """Write the lines of a text in UTF-8, without `sep=`, the header's `#` and closing separators."""
    while line := text.readline(LINE_CHARACTERS + 1):
        if is_marked:
            is_marked = False
            continue
        if out.tell() == 0:
            line = _COMMENT.sub("", line, count=1)
        if closing:
            body = line.rstrip("\r\n")
            line = body.removesuffix(closing) + line[len(body) :]
        out.write(line.encode())
