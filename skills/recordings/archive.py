"""Zip archives: read what a stranger sent without trusting a word of it, and write our own.

Nothing is unpacked under a name of the archive's, so its paths lead nowhere. What an archive says of itself is a claim:
the list of its members is measured before it is read, what a member unpacks to is counted while it unpacks, and its
checksum is compared at its end. Refused are more than `MEMBERS` members, two of one name, passwords, other
compressions than none and deflate, archives in the archive, and what unpacks to more than `RATIO` times its size.
"""

import io
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import PurePosixPath
from typing import IO, BinaryIO

from skills.errors import UnreadableRecording
from skills.recordings.refusing import refusing

MAGIC = b"PK\x03\x04"
MEMBERS = 2000  # a session of both recorders has a few dozen, and all of JIGSAWS 300
LIST_BYTES = 1 << 20  # what 2000 members take in the list, with long names
TOTAL_BYTES = 4 << 30  # of all members that are read; an MCAP file's own limit
TEXT_BYTES = 32 << 20  # of a member that is read into memory
RATIO, FREE_BYTES = 200, 16 << 20  # deflate reaches 1030; an uncompressed bag of an arm that rests about 20
_PIECE = 1 << 20
_END = struct.Struct("<4s4H2LH")  # the record at the end of an archive, without its comment
_ZIP64 = b"PK\x06\x07"
_NESTED = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
_ENCRYPTED = 0x1
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the first moment that a zip archive knows


class Archive:
    """The members of an archive by name; folders are left out."""

    def __init__(self, file: BinaryIO) -> None:
        _check_end(file)
        with refusing("The zip archive", "Pack it again."):
            self._zip = zipfile.ZipFile(file)
        infos = [info for info in self._zip.infolist() if not info.is_dir()]
        _check_members(infos)
        self._infos = {info.filename: info for info in infos}
        self._left = TOTAL_BYTES

    @property
    def names(self) -> list[str]:
        """The names of the members, sorted."""
        return sorted(self._infos)

    def size(self, name: str) -> int:
        """Say what a member claims to unpack to, in bytes; it never unpacks to more."""
        return self._infos[name].file_size

    def text(self, name: str) -> str:
        """Return a short member as text.

        Raises:
            UnreadableRecording: Damaged, longer than `TEXT_BYTES`, or no UTF-8.
        """
        if self._infos[name].file_size > TEXT_BYTES:
            raise UnreadableRecording(f"{shown(name)} in the archive is over {TEXT_BYTES} bytes; leave it out.")
        with io.BytesIO() as out:
            self._copy(name, out)
            try:
                return out.getvalue().decode("utf-8-sig")
            except UnicodeDecodeError as error:
                raise UnreadableRecording(f"{shown(name)} in the archive is no UTF-8 text.") from error

    @contextmanager
    def unpacked(self, name: str) -> Iterator[BinaryIO]:
        """Unpack a member into a temporary file, at its beginning.

        Raises:
            UnreadableRecording: Damaged, or it unpacks to too much.
        """
        with tempfile.TemporaryFile() as out:
            self._copy(name, out)
            out.seek(0)
            yield out

    def _copy(self, name: str, out: IO[bytes]) -> None:
        info = self._infos[name]
        limit = min(self._left, max(FREE_BYTES, RATIO * info.compress_size))
        if info.file_size > limit:
            raise UnreadableRecording(
                f"{shown(name)} in the archive claims to unpack from {info.compress_size} to {info.file_size} bytes; "
                f"no recording does. Send the .mcap file itself.",
                packed_bytes=info.compress_size,
                unpacked_bytes=info.file_size,
            )
        size = 0
        with refusing(f"{shown(name)} in the archive", "Send it again."), self._zip.open(info) as member:
            while data := member.read(_PIECE):
                size += len(data)
                if size > limit:
                    raise UnreadableRecording(f"{shown(name)} unpacks to more than it claims. Pack it again.")
                out.write(data)
        if size != info.file_size:
            raise UnreadableRecording(f"{shown(name)} in the archive is cut short. Send it again.")
        self._left -= size


def pack(members: Mapping[str, IO[bytes]], out: IO[bytes]) -> None:
    """Write an archive: the same members give the same bytes. Recordings compress themselves, so nothing is packed."""
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, file in members.items():
            with archive.open(zipfile.ZipInfo(name, _EPOCH), "w") as member:
                shutil.copyfileobj(file, member, _PIECE)


def shown(name: str) -> str:
    """Return a member's name fit for a message: its last part, printable, and not long."""
    last = PurePosixPath(name).name or name
    return repr("".join(letter if letter.isprintable() else "?" for letter in last)[:80])


def _check_end(file: BinaryIO) -> None:
    """Refuse an archive whose list of members is too long to be read, or that does not end where its list does.

    An archive with a comment, or in the zip64 form that sizes over 4 GiB need, is refused as well: both give a second
    place where an end may stand, and readers disagree about which one counts.
    """
    size = file.seek(0, io.SEEK_END)
    if size < _END.size:
        raise UnreadableRecording("The zip archive is truncated. Pack it again.")
    file.seek(max(0, size - _END.size - 20))
    before, end = file.read(20) if size >= _END.size + 20 else b"", file.read(_END.size)
    magic, _, _, _, members, list_bytes, _, comment_bytes = _END.unpack(end)
    if magic != b"PK\x05\x06" or comment_bytes:
        raise UnreadableRecording(
            "The zip archive is truncated, or something follows its end; pack it again, without a comment."
        )
    if before.startswith(_ZIP64) or members > MEMBERS or list_bytes > LIST_BYTES:
        raise UnreadableRecording(
            f"The zip archive has more than {MEMBERS} members or more than 4 GiB; send one bag at a time.",
            members=members,
        )
    file.seek(0)


def _check_members(infos: list[zipfile.ZipInfo]) -> None:
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
            raise UnreadableRecording(f"{name} is compressed in a way that is not read here. Pack it with deflate.")
        if info.filename.lower().endswith(_NESTED):
            raise UnreadableRecording(f"{name} is an archive in the archive. Unpack it first.")
