"""An `.npz` archive as `np.savez_compressed` writes it, by Intel's deflate: a tenth of the time for twice the bytes.

A policy's Q values are two megabytes; numpy's way of compressing them takes as long as learning them did (measured in
`tests/bench/batches.py`). Any reader of zip files reads the archive, and any such archive is read here.
"""

import io
import re
from struct import pack, unpack_from
from typing import IO, Any

import numpy as np
from isal import isal_zlib

LEVEL = 1  # 2 is no smaller, 3 takes three times as long for a tenth less
RAW = -15  # deflate as zip files hold it, without a header of its own
MAX_BYTES = 2**31  # what has larger parts is left to numpy, which knows the form for them
STORED, DEFLATED, NEEDED, NO_DATE = 0, 8, 20, 0x21
LOCAL, CENTRAL, END = b"PK\3\4", b"PK\1\2", b"PK\5\6"
LOCAL_BYTES, CENTRAL_BYTES, END_BYTES = 30, 46, 22

Arrays = dict[str, np.ndarray[Any, Any]]
# The head of a plain array, as numpy writes it: magic and version 1.0, its own length, and a dictionary.
HEAD = re.compile(
    rb"\x93NUMPY\x01\x00[\x00-\xff]{2}"
    rb"\{'descr': '([<|][fiub]\d)', 'fortran_order': False, 'shape': \(([\d, ]*)\), \} *\n"
)


def save(file: IO[bytes], **arrays: np.ndarray[Any, Any]) -> None:
    """Write arrays into an empty file, each under its name."""
    if sum(array.nbytes for array in arrays.values()) > MAX_BYTES:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        return
    directory, at = [], 0
    for name, array in arrays.items():
        array = np.asarray(array, order="C")
        head, member = _head(array), f"{name}.npy".encode()
        data = array.reshape(-1).view(np.uint8).data
        squeezer = isal_zlib.compressobj(LEVEL, isal_zlib.DEFLATED, RAW)
        parts = [squeezer.compress(head), squeezer.compress(data), squeezer.flush()]
        crc, stored, whole = _crc(head, data), sum(map(len, parts)), len(head) + len(data)
        said = pack("<4H3L2H", 0, DEFLATED, 0, NO_DATE, crc, stored, whole, len(member), 0)
        file.writelines([LOCAL, pack("<H", NEEDED), said, member, *parts])
        directory += [CENTRAL, pack("<2H", NEEDED, NEEDED), said, pack("<3H2L", 0, 0, 0, 0, at), member]
        at += LOCAL_BYTES + len(member) + stored
    size = sum(map(len, directory))
    file.writelines([*directory, END, pack("<4H2LH", 0, 0, len(arrays), len(arrays), size, at, 0)])


def load(data: bytes) -> Arrays:
    """Read all arrays of an archive that is known to be whole; what it does not hold in the usual form numpy reads.

    Raises:
        Exception: Of any class, where it is no such archive.
    """
    try:
        return dict(_members(data))
    except _Unusual:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}


class _Unusual(Exception):
    """An archive, or an array in it, that is not as `save` or numpy write plain ones."""


def _members(data: bytes) -> list[tuple[str, np.ndarray[Any, Any]]]:
    if data[-END_BYTES : 4 - END_BYTES] != END:
        raise _Unusual
    count, size, at = unpack_from("<H2L", data, len(data) - END_BYTES + 10)
    if at + size + END_BYTES != len(data):
        raise _Unusual
    found = []
    for _ in range(count):
        method, crc, stored, whole, name, extra, comment, start = unpack_from("<10xH4xLLLHHH8xL", data, at)
        member = data[at + CENTRAL_BYTES : at + CENTRAL_BYTES + name].decode()
        at += CENTRAL_BYTES + name + extra + comment
        begin = start + LOCAL_BYTES + sum(unpack_from("<2H", data, start + LOCAL_BYTES - 4))
        raw = memoryview(data)[begin : begin + stored]
        if method not in (STORED, DEFLATED) or not member.endswith(".npy"):
            raise _Unusual
        content = isal_zlib.decompress(raw, RAW, whole) if method == DEFLATED else raw
        if len(content) != whole or isal_zlib.crc32(content) != crc:
            raise _Unusual
        found.append((member.removesuffix(".npy"), _array(content)))
    return found


def _array(content: bytes | memoryview) -> np.ndarray[Any, Any]:
    """Read an array, without copying it: it is read-only, as bytes are."""
    head = HEAD.match(content)
    if head is None:
        raise _Unusual
    shape = [int(side) for side in head[2].split(b",") if side.strip()]
    return np.frombuffer(content, np.dtype(head[1].decode()), offset=head.end()).reshape(shape)


def _head(array: np.ndarray[Any, Any]) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, np.lib.format.header_data_from_array_1_0(array))
    return out.getvalue()


def _crc(head: bytes, data: memoryview) -> int:
    return isal_zlib.crc32(data, isal_zlib.crc32(head))
