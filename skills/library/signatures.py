"""Signatures of policies, cards and replay bags, each under a checkpoint of the history that covers its rows.

    rows --head_over--> the first checkpoint that covers them --sign_files--> a signed envelope about files

Nothing is signed that the history does not have: the rows must be as their newest leaves say, and the leaves under the
signed root. So somebody who can only write to the database gets no signature of what he wrote.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, select

from skills.attestation import attest
from skills.db.history import CHECKPOINTS, History
from skills.db.session import Database
from skills.errors import Busy
from skills.library.history import sign_history
from skills.library.proofs import covered_leaf, logged_leaf
from skills.transparency import Note, read_notes

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
        sign_history(database, None)
    raise Busy("The history is not signed up to these rows yet; try again in a second.")


def first_head(connection: Connection, history: History, rows: Rows) -> Note | None:
    """Return the first signed checkpoint that covers some rows; None if there is none yet.

    Raises:
        Corrupt: A row is not as the history has it, or the history is not as it was signed.
        BadSettings: The signing key cannot be read.
    """
    leaves = [logged_leaf(connection, table, str(row)) for table, row in rows]
    numbers = [number for _, number in leaves if number is not None]
    if len(numbers) < len(leaves):
        return None
    query = select(CHECKPOINTS.c.note).where(CHECKPOINTS.c.size > max(numbers)).order_by(CHECKPOINTS.c.size)
    for note in connection.scalars(query):
        (head,) = read_notes(note)
        if head.signed_by(history.key.public):  # those of an installation that a backup came from are not
            for leaf, number in zip(leaves, numbers, strict=True):
                covered_leaf(connection, leaf[0], number, head.checkpoint)
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
