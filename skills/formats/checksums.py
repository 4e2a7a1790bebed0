"""SHA-256 checksums of files, and lists of them in the format of `sha256sum -c`."""

import hashlib
import re
from collections.abc import Callable, Mapping
from typing import IO

SUMS = "SHA256SUMS"  # the name of the file with the list

_PIECE = 1 << 20
_LINE = re.compile(r"([0-9a-f]{64})  (\S+)")


def write_sums(digests: Mapping[str, str]) -> bytes:
    """Return the list of some files, from their digests by name."""
    return "".join(f"{digests[name]}  {name}\n" for name in sorted(digests)).encode()


def read_sums(text: str) -> dict[str, str]:
    """Return the digests by name, in hex; empty if a line is of another form, or two are of one file."""
    lines = [_LINE.fullmatch(line) for line in text.splitlines()]
    digests = {line[2]: line[1] for line in lines if line is not None}
    return digests if len(digests) == len(lines) else {}


def digest_of(file: IO[bytes], each: Callable[[bytes], object] = len) -> str:
    """Return the SHA-256 of the rest of a file, in hex; `each` is called with every part of its content."""
    seen = hashlib.sha256()
    while data := file.read(_PIECE):
        seen.update(data)
        each(data)
    return seen.hexdigest()
