"""Proofs of the history for a third party, and signatures of files under its checkpoints.

A proof says which version of a style was served at a time. It is checked without the service and the database, given
the verifier's key: the disclosed columns give some of the digests, the digests the commitment in the entry, and the
entry with the hashes beside its path the signed root.

Policies, cards and replay bags are signed under a checkpoint of the history that covers their rows:

    rows --head_over--> the first checkpoint that covers them --sign_files--> a signed envelope about files

Nothing is signed that the history does not have: the rows must be as their newest leaves say, and the leaves under the
signed root. So somebody who can only write to the database gets no signature of what he wrote.
"""

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, or_, select
from sqlalchemy.orm import Session

from skills.db.history import History
from skills.db.leaves import CHECKPOINTS, newest_checkpoint
from skills.db.logged_rows import as_bytes, logged
from skills.db.models import PolicyVersion, Release
from skills.db.session import Database
from skills.errors import Busy, NotFound
from skills.library.operation.history import covered_leaf, logged_leaf, sign_history
from skills.library.people.surgeons import find_surgeon
from skills.schemas.responses import LeafProof, ServedAt, SignedCheckpoint
from skills.transparency.merkle import Checkpoint
from skills.transparency.notes import Note, read_notes
from skills.transparency.statements import attest

DISCLOSED = {  # of the rows that a proof is about; the digests of their other columns reveal nothing without a guess
    "releases": ("row", "policy_row", "surgeon_row", "suture", "released_at", "released_by", "withdrawn_at"),
    "policy_versions": ("row", "sha256"),
}


def signed_checkpoint(connection: Connection, history: History) -> SignedCheckpoint:
    """Return the newest signed checkpoint and the public key that verifies it.

    Raises:
        BadSettings: The signing key cannot be read.
        Busy: No history was begun yet.
    """
    note = newest_checkpoint(connection)
    if note is None:
        raise Busy("No history was begun yet; try again in a moment.")
    return SignedCheckpoint(note=note, verifier=history.key.verifier(note.partition("\n")[0]))


def served_at(session: Session, history: History, surgeon: str, suture: str, at: datetime) -> ServedAt:
    """Return the version of a style that was served at a time, with the proof of its release and of its digest.

    It reads a few tiles of the history, see `skills.db.tiles`, however many leaves there are.

    Raises:
        NotFound: There is no such surgeon, or nothing was released then.
        Busy: The release is not under a signed checkpoint yet.
        BadSettings: The signing key cannot be read.
        Corrupt: The history is not whole.
    """
    of_style = (Release.surgeon_row == find_surgeon(session, surgeon).row, Release.suture == suture)
    in_force = (Release.released_at <= at, or_(Release.withdrawn_at.is_(None), Release.withdrawn_at > at))
    query = select(Release, PolicyVersion.sha256).join(PolicyVersion, PolicyVersion.row == Release.policy_row)
    found = session.execute(query.where(*of_style, *in_force).order_by(Release.row.desc()).limit(1)).first()
    if found is None:
        raise NotFound("No version of this style was released at that time.")
    release, sha256 = found
    connection = session.connection()
    checkpoint = signed_checkpoint(connection, history)
    signed = read_notes(checkpoint.note)[0].checkpoint
    rows = (("releases", release.row), ("policy_versions", release.policy_row))
    return ServedAt(
        surgeon=surgeon,
        suture=suture,
        at=at,
        policy=sha256,
        released_at=release.released_at,
        withdrawn_at=release.withdrawn_at,
        proofs=[_proof(connection, history, table, str(row), signed) for table, row in rows],
        checkpoint=checkpoint,
    )


def _proof(connection: Connection, history: History, table: str, key: str, signed: Checkpoint) -> LeafProof:
    """Return the proof of a row's newest leaf under a checkpoint."""
    leaf = logged_leaf(connection, history, table, key)
    if leaf.number is None or leaf.number >= signed.size:
        raise Busy("The history is not signed up to this release yet; try again in a second.")
    (row,) = logged()[table].rows_of(connection, [key])
    disclosed = [name for name in DISCLOSED[table] if name in leaf.digests]  # a leaf of before an added column
    return LeafProof(
        table=table,
        number=leaf.number,
        entry=leaf.entry,
        salt=leaf.salt.hex(),
        disclosed={name: as_bytes(getattr(row, name))[1:].decode() for name in disclosed},
        digests=dict(leaf.digests),
        hashes=[one.hex() for one in covered_leaf(connection, leaf, signed)],
    )


Rows = Sequence[tuple[str, int]]  # a table, and the key of a row in it


def head_over(database: Database, rows: Rows) -> Note:
    """Return the first signed checkpoint that covers some rows; the history is signed if there is none yet.

    Raises:
        Corrupt: A row is not as the history has it, or the history is not as it was signed.
        Busy: The history cannot be signed now.
        BadSettings: The signing key cannot be read.
    """
    for _ in range(2):
        with database.reading() as session:
            head = first_head(session.connection(), database.history, rows)
        if head is not None:
            return head
        sign_history(database)
    raise Busy("The history is not signed up to these rows yet; try again in a second.")


def first_head(connection: Connection, history: History, rows: Rows) -> Note | None:
    """Return the first signed checkpoint that covers some rows; None if there is none yet.

    Raises:
        Corrupt: A row is not as the history has it, or the history is not as it was signed.
        BadSettings: The signing key cannot be read.
    """
    leaves = [logged_leaf(connection, history, table, str(row)) for table, row in rows]
    numbers = [leaf.number for leaf in leaves if leaf.number is not None]
    if len(numbers) < len(leaves):
        return None
    query = select(CHECKPOINTS.c.note).where(CHECKPOINTS.c.size > max(numbers)).order_by(CHECKPOINTS.c.size)
    for note in connection.scalars(query):
        (head,) = read_notes(note)
        if head.signed_by(history.key.public):  # those of an installation that a backup came from are not
            for leaf in leaves:
                covered_leaf(connection, leaf, head.checkpoint)
            return head
    return None


def sign_files(history: History, head: Note, digests: Mapping[str, str], **facts: Any) -> bytes:
    """Return a signed envelope about files.

    Args:
        history: The history, with its key.
        head: The checkpoint that covers what the files are made of.
        digests: The SHA-256 of each file in hex, by name.
        facts: What is said about the files, as plain JSON.
    """
    return attest(digests, {**facts, "checkpoint": head.text}, history.key, head.checkpoint.origin)
