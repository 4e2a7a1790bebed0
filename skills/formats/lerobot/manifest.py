"""The zip of a written dataset: verified against its manifest, and unpacked.

A written dataset has a manifest: `unpack_dataset` verifies every file against its SHA-256 before the folder appears.
Only what `skills.formats.lerobot.writer` writes into a zip is unpacked: files that are not compressed, so that none is
larger than the zip itself, with names that stay in the folder, each of them named by the manifest and no other.
"""

import re
import secrets
import shutil
from pathlib import Path
from typing import IO, BinaryIO
from zipfile import ZIP_STORED, ZipFile

from skills.errors import BadInput, Corrupt
from skills.formats.archive import refusing
from skills.formats.checksums import SUMS, digest_of, read_sums

AGAIN = "Download it again."
_NAME = re.compile(r"(?:[A-Za-z0-9_-][A-Za-z0-9._-]*/)*[A-Za-z0-9._-]*[A-Za-z0-9_-][A-Za-z0-9._-]*")
_MANIFEST_BYTES = 16 << 20  # 100,000 files


def check_dataset(file: BinaryIO) -> list[str]:
    """Verify every file of a dataset's zip against its manifest, and return their names.

    Raises:
        Corrupt: A file differs from its digest, is missing, or is not in the manifest.
        UnreadableRecording: It is not a zip, or is damaged.
    """
    return _copied(file, None)


def unpack_dataset(file: BinaryIO, folder: Path) -> list[str]:
    """Unpack a dataset's zip into a new folder, which appears only when all files are verified; return their names.

    Raises:
        BadInput: There is something at the folder's path.
        Corrupt, UnreadableRecording: As `check_dataset`.
    """
    refuse_existing(folder)
    part = folder.with_name(f".{folder.name}.{secrets.token_hex(8)}")
    part.mkdir()
    try:
        names = _copied(file, part)
        refuse_existing(folder)  # again: meanwhile somebody else may have made it
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return names


def refuse_existing(path: Path) -> None:
    """Refuse to overwrite something.

    Raises:
        BadInput: There is a file, a folder or a link at the path.
    """
    if path.exists() or path.is_symlink():
        raise BadInput(f"{path} exists already, and is not overwritten.", "Name a new folder, or a new .zip.")


def _copied(file: BinaryIO, folder: Path | None) -> list[str]:
    """Verify every file, and write it into the folder if there is one; raises as `check_dataset`."""
    with refusing("The dataset's zip", AGAIN), ZipFile(file) as archive:
        found = {one.filename: one for one in archive.infolist()}
        named = _manifest(archive) if SUMS in found else {}
        if len(found) != len(archive.infolist()) or found.keys() != {*named, SUMS} or not named:
            raise Corrupt(f"The files of the dataset are not those of its manifest. {AGAIN}")
        for name, member in found.items():
            if member.compress_type != ZIP_STORED or _NAME.fullmatch(name) is None:
                raise Corrupt(f"The dataset's zip has a member that no export writes. {AGAIN}")
            with archive.open(member) as content:
                digest = _copy(content, None if folder is None else folder / name)
            if name != SUMS and digest != named[name]:
                raise Corrupt(f"{name} of the dataset does not match its manifest. {AGAIN}")
    return sorted(found)


def _manifest(archive: ZipFile) -> dict[str, str]:
    """Return the SHA-256 of each file that the manifest names."""
    if archive.getinfo(SUMS).file_size > _MANIFEST_BYTES:
        raise Corrupt(f"The dataset's manifest is too long. {AGAIN}")
    return read_sums(archive.read(SUMS).decode("ascii"))


def _copy(content: IO[bytes], to: Path | None) -> str:
    """Write a file, unless `to` is None, and return its SHA-256."""
    if to is None:
        return digest_of(content)
    to.parent.mkdir(parents=True, exist_ok=True)
    with to.open("wb") as out:
        return digest_of(content, out.write)
