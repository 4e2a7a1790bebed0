"""Zip archives: reading untrusted ones and writing our own; uniform errors for libraries that fail on damaged files.

Nothing is unpacked to a path from the archive, so path traversal is impossible. The archive's metadata is not trusted:
the size of the member list is checked before it is read, the unpacked size of a member is counted while it unpacks, and
its checksum is compared at its end. Refused are more than `MEMBERS` members, duplicate names, encryption, compression
methods other than none and deflate, nested archives, and members that unpack to more than `RATIO` times their size.
"""

import errno
import io
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import PurePosixPath
from typing import IO, BinaryIO

from skills.errors import SkillsError, UnreadableRecording

_LIMITS = (errno.EFBIG, errno.ENOSPC, errno.EDQUOT)


@contextmanager
def refusing(what: str, advice: str) -> Iterator[None]:
    """Convert any exception of a library into a refusal, except where a resource limit of this process was reached.

    Args:
        what: Subject of the message's first sentence, such as "The zip archive".
        advice: The remedy, as a sentence.

    Raises:
        UnreadableRecording: Any other exception was raised; a `SkillsError` or `MemoryError`, and an `OSError` for a
            limit of file size, disk space or quota, pass unchanged.
    """
    try:
        yield
    except (SkillsError, MemoryError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _LIMITS:
            raise
        raise UnreadableRecording(f"{what} is truncated or corrupt. {advice}") from error


HEAD_BYTES = 100  # of a file, in which a pointer of Git LFS is recognised
_POINTER = b"version https://git-lfs.github.com/spec/"


def check_pointer(head: bytes) -> None:
    """Refuse the text that Git stores in place of a large file.

    Raises:
        UnreadableRecording: A file with this head is such a pointer.
    """
    if head.startswith(_POINTER):
        raise UnreadableRecording(
            "A file is a pointer of Git LFS, and not the recording itself: get that with `git lfs pull`, and send it."
        )


MAGIC = b"PK\x03\x04"
MEMBERS = 2000  # a session of either recorder has a few dozen, and all of JIGSAWS 300
LIST_BYTES = 1 << 20  # size of the member list of 2000 members with long names
TOTAL_BYTES = 4 << 30  # of all members that are read together; the same as an MCAP file's limit
TEXT_BYTES = 32 << 20  # of a member that is read into memory
RATIO, FREE_BYTES = 200, 16 << 20  # deflate reaches 1030; an uncompressed bag of an arm at rest about 20
_PIECE = 1 << 20
_END = struct.Struct("<4s4H2LH")  # the record at the end of an archive, without its comment
_ZIP64 = b"PK\x06\x07"
_NESTED = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
_ENCRYPTED = 0x1
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date in the zip format; constant, so that equal members give equal bytes


class Archive:
    """The members of an untrusted zip archive, by name; folders are left out."""

    def __init__(self, file: BinaryIO) -> None:
        _check_end(file)
        with refusing("The zip archive", "Pack it again."):
            self._zip = zipfile.ZipFile(file)
        infos = [info for info in self._zip.infolist() if not info.is_dir()]
        _check_members(infos)
        with refusing("The zip archive", "Pack it again."):
            for info in infos:
                # Compares its two names: a member with a damaged one would be missed and not missing.
                self._zip.open(info).close()
        self._infos = {info.filename: info for info in infos}
        self._left = TOTAL_BYTES

    @property
    def names(self) -> list[str]:
        """The names of the members, sorted."""
        return sorted(self._infos)

    def size(self, name: str) -> int:
        """Return the claimed unpacked size of a member in bytes; the real one is never larger."""
        return self._infos[name].file_size

    def text(self, name: str, errors: str = "strict") -> str:
        """Return a short member as text; `errors` says what becomes of bytes that are not UTF-8.

        Raises:
            UnreadableRecording: Damaged, longer than `TEXT_BYTES`, or not UTF-8.
        """
        if self._infos[name].file_size > TEXT_BYTES:
            raise UnreadableRecording(f"{shown(name)} in the archive is over {TEXT_BYTES} bytes; leave it out.")
        with io.BytesIO() as out:
            self._copy(name, out)
            try:
                return out.getvalue().decode("utf-8-sig", errors)
            except UnicodeDecodeError as error:
                raise UnreadableRecording(f"{shown(name)} in the archive is not UTF-8 text.") from error

    @contextmanager
    def unpacked(self, name: str) -> Iterator[BinaryIO]:
        """Unpack a member into a temporary file, and yield it at its beginning.

        Raises:
            UnreadableRecording: Damaged, or it unpacks to too much.
        """
        with tempfile.TemporaryFile() as out:
            self._copy(name, out)
            out.seek(0)
            yield out

    def _copy(self, name: str, out: IO[bytes]) -> None:
        """Unpack a member, counting its bytes against its claimed size and the limits."""
        info = self._infos[name]
        limit = min(self._left, max(FREE_BYTES, RATIO * info.compress_size))
        if info.file_size > limit:
            raise UnreadableRecording(
                f"{shown(name)} in the archive declares {info.file_size} bytes unpacked from "
                f"{info.compress_size}, which is not plausible for a recording. Send the .mcap file itself.",
                packed_bytes=info.compress_size,
                unpacked_bytes=info.file_size,
            )
        size = 0
        with refusing(f"{shown(name)} in the archive", "Send it again."), self._zip.open(info) as member:
            while data := member.read(_PIECE):
                size += len(data)
                if size > limit:
                    raise UnreadableRecording(f"{shown(name)} unpacks to more than its declared size. Pack it again.")
                out.write(data)
        if size != info.file_size:
            raise UnreadableRecording(f"{shown(name)} in the archive is truncated. Send it again.")
        self._left -= size
        out.seek(0)
        check_pointer(out.read(len(_POINTER)))


def pack(members: Mapping[str, IO[bytes]], out: IO[bytes]) -> None:
    """Write an archive without compression, since recordings are compressed already.

    The same members give the same bytes.
    """
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, file in members.items():
            with archive.open(zipfile.ZipInfo(name, _EPOCH), "w") as member:
                shutil.copyfileobj(file, member, _PIECE)


def shown(name: str) -> str:
    """Return a member's name as it may appear in a message: its last component, quoted."""
    return repr(printable(PurePosixPath(name).name or name))


def printable(value: object, most: int = 80) -> str:
    """Return text of a file as it may appear in a message: other letters replaced, at most so many.

    JSON may contain unpaired surrogates, which cannot be encoded.
    """
    return "".join(letter if letter.isprintable() else "?" for letter in str(value)[:most])


def _check_end(file: BinaryIO) -> None:
    """Refuse an archive whose member list is too long, or that does not end directly after its end record.

    An archive with a comment, or in the zip64 form that sizes over 4 GiB need, is refused as well: both allow a second
    place for the end record, and readers disagree on which one counts.
    """
    size = file.seek(0, io.SEEK_END)
    if size < _END.size:
        raise UnreadableRecording("The zip archive is truncated. Pack it again.")
    file.seek(max(0, size - _END.size - 20))
    before, end = file.read(20) if size >= _END.size + 20 else b"", file.read(_END.size)
    magic, _, _, _, members, list_bytes, _, comment_bytes = _END.unpack(end)
    if magic != b"PK\x05\x06" or comment_bytes:
        raise UnreadableRecording(
            "The zip archive is truncated, or has data after its end; pack it again, without a comment."
        )
    if before.startswith(_ZIP64) or members > MEMBERS or list_bytes > LIST_BYTES:
        raise UnreadableRecording(
            f"The zip archive has more than {MEMBERS} members or more than 4 GiB; send one bag at a time.",
            members=members,
        )
    file.seek(0)


def _check_members(infos: list[zipfile.ZipInfo]) -> None:
    """Refuse too many members, two of one name, encryption, unknown compression, and archives in the archive."""
    if len(infos) > MEMBERS:
        raise UnreadableRecording(f"The zip archive has more than {MEMBERS} members; send one bag at a time.")
    seen: set[str] = set()
    for info in infos:
        name = shown(info.filename)
        if info.filename in seen:
            raise UnreadableRecording(f"The archive has {name} twice. Pack it again.")
        seen.add(info.filename)
        if info.flag_bits & _ENCRYPTED:
            raise UnreadableRecording(f"{name} in the archive is encrypted. Pack it without a password.")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise UnreadableRecording(f"{name} has an unsupported compression. Pack it with deflate.")
        if info.filename.lower().endswith(_NESTED):
            raise UnreadableRecording(f"{name} is an archive in the archive. Unpack it first.")
