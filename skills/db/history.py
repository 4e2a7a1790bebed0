"""The history: a leaf of a Merkle log for each change of a logged row, written in the transaction of the change.

Before the commit `History.settle` reads the rows that the transaction has changed (`skills.db.change_notes`), as it
leaves them, and adds a leaf for each (`skills.db.leaves`). `skills.library.operation.history` numbers the leaves, signs
the tree and verifies all of it. `skills.db.logged_rows` names the logged tables and columns.
"""

import hmac
import os
import secrets
import tempfile
from collections.abc import Sequence
from functools import cached_property
from itertools import chain
from pathlib import Path

from sqlalchemy import URL, Connection, Engine, bindparam, insert, inspect, select, update

from skills.db import now, rfc3339
from skills.db.change_notes import ADD, CHANGE, NOTING, effects_of, take_notes
from skills.db.leaves import (
    CHECKPOINTS,
    LEAVES,
    NewLeaf,
    add_leaves,
    latest_leaves,
    leaves_of_changes,
    new_leaf,
    newest_checkpoint,
    removals,
)
from skills.db.logged_rows import logged, schema_of
from skills.db.saved_heads import ANOTHER, archive_heads, heads_file_for, last_head
from skills.errors import BadSettings, Corrupt, NotReady
from skills.remedies import Action, Remedy
from skills.transparency.merkle import HASH_BYTES, Checkpoint, Tree, leaf_hash
from skills.transparency.notes import Note, read_notes
from skills.transparency.signing_keys import Seal, SigningKey

SCHEMA = "schema"  # the name under which triggers, indexes and constraints are logged as if they were rows
SIGNED_AT_ONCE = 1000  # leaves in one transaction, some 50 ms
ORIGIN = "suture-skills/"  # and 16 random hex digits: the name of one log
HISTORY = "history"  # in a session's `info`: the `History` of its database
REMOVED = (
    "The history of this database was removed, so nobody can tell what was changed in it.",
    "Put the right copy of the database back, or restore a backup into an empty one.",
)


class History:
    """The history of one database, written with the signing key of this installation."""

    def __init__(self, engine: Engine, key_file: Path, heads_file: Path | None) -> None:
        """Name the database, the file of the key, and that of the saved heads; they are read at the first use."""
        self._engine = engine
        self.key_file = key_file
        if heads_file is not None and not heads_file.parent.is_dir():
            raise BadSettings(
                f"The folder {heads_file.parent} of SKILLS_CHECKPOINTS does not exist, so no head could be saved.",
                "Make it, or mount its disk.",
                ANOTHER,
            )
        self.heads_file = heads_file or heads_file_for(key_file, engine.url)
        self._why: tuple[str, *tuple[str | Remedy, ...]] | None = None  # nothing is served or written
        self._agreed: tuple[str | None, Note | None] | None = None  # the newest checkpoint, and the saved head
        self._seal: Seal | None = None
        self._origin: str | None = None

    @cached_property
    def key(self) -> SigningKey:
        """The signing key.

        Raises:
            BadSettings: The file is missing or cannot be read.
            Corrupt: It is not a key.
        """
        try:
            return SigningKey.read(self.key_file.read_text())
        except (OSError, UnicodeDecodeError) as error:
            why = "is missing" if isinstance(error, FileNotFoundError) else "cannot be read"
            raise BadSettings(
                f"The signing key {why}, and this database has a history that was begun with one.",
                "Put its file back, or name it in SKILLS_SIGNING_KEY.",
            ) from error

    def origin(self, connection: Connection) -> str | None:
        """Return the name of the log; None where none was begun."""
        if self._origin is None:
            first = connection.scalar(select(CHECKPOINTS.c.note).order_by(CHECKPOINTS.c.row).limit(1))
            self._origin = None if first is None else first.partition("\n")[0]
        return self._origin

    @property
    def refused(self) -> NotReady | None:
        """Why nothing of the database is served or written, see `compare`; a new error, without an old traceback."""
        return NotReady(*self._why) if self._why else None

    def saved_head(self) -> Note | None:
        """Return the head that was saved last; None if none was.

        Raises:
            NotReady: It cannot be read.
        """
        try:
            return last_head(self.heads_file)
        except NotReady as refused:
            self._why = (refused.message, *refused.remedies)
            raise

    def saved_heads(self) -> list[Note]:
        """Return all saved heads, of whichever log.

        Raises:
            Corrupt: The file has anything else.
        """
        if not self.heads_file.exists():
            return []
        return read_notes(self.heads_file.read_text())

    def compare(self, connection: Connection, saved: Note | None) -> None:
        """Compare the database with the signing key and with the head that was saved last; the result is `refused`.

        Args:
            connection: In a transaction.
            saved: The head, read before the transaction began, as it must not be newer than what that sees.

        Raises:
            NotReady: The database is not the one that was signed last: older, another one, or signed with another key.
        """
        newest = newest_checkpoint(connection)
        if (newest, saved) == self._agreed:
            return
        try:
            self._refuse_another(connection, newest, saved)
        except NotReady as refused:
            self._why, self._agreed = (refused.message, *refused.remedies), None
            raise
        self._why, self._agreed = None, (newest, saved)

    def _refuse_another(self, connection: Connection, newest: str | None, saved: Note | None) -> None:
        """Refuse the database; the message names no path, for it is also given to callers without a key."""
        if newest is None:
            if saved is not None:
                raise NotReady(*REMOVED)
            return  # no history was begun
        try:
            (note,), key = read_notes(newest), self.key
        except (BadSettings, Corrupt) as error:
            raise NotReady(error.message, *error.remedies) from error
        if not note.signed_by(key.public):
            raise NotReady(
                "The history of this database was signed with another key, and what is written with this one could not "
                "be verified.",
                "Name the file of the right key in SKILLS_SIGNING_KEY. If it is lost, restore a backup into an empty "
                "database, whose history then goes on with this key.",
            )
        if saved is None or saved == note:
            return
        head, here = saved.checkpoint, note.checkpoint
        if head.origin != here.origin and here.size == 0:
            return  # a history that has just begun takes the place of another
        known = select(CHECKPOINTS.c.row).where(CHECKPOINTS.c.size == head.size, CHECKPOINTS.c.note == saved.text)
        if connection.scalar(known) is None:
            is_older = head.origin == here.origin and here.size < head.size
            raise NotReady(
                f"This database is {'older' if is_older else 'another'} than the one whose history was saved last: "
                f"that one has {head.size} leaves, and this {here.size} without that head. Withdrawn releases and "
                "consents, revoked keys and erased surgeons may be back in it.",
                "Put the right copy of the database back.",
                Remedy(Action.ACCEPT_ROLLBACK),
            )

    def settle(self, connection: Connection) -> None:
        """Add a leaf for each logged row that the transaction has changed; call it before the commit.

        Raises:
            NotReady: The database is not the one that was signed last, see `compare`.
        """
        if not connection.info.get(NOTING):
            return  # the job engine's database, or one that is not migrated yet
        effects, at = effects_of(take_notes(connection)), rfc3339(now())
        changed = [table for table in effects if table in logged()]
        each = (leaves_of_changes(connection, table, effects[table], at) for table in changed)
        self._write(connection, [*chain.from_iterable(each)])  # in one statement

    def _write(self, connection: Connection, leaves: Sequence[NewLeaf]) -> None:
        if not leaves:
            return
        if self._seal is None:
            origin = self.origin(connection)
            self.compare(connection, self.saved_head())
            if origin is None:
                raise NotReady(*REMOVED)
            self._seal = self.key.seal_of(origin)
        if (refused := self.refused) is not None:
            raise refused
        add_leaves(connection, leaves, self._seal)

    # ---- beginning, migrations and restorations

    def begin(self, connection: Connection) -> None:
        """Begin a history, if there is none: make a key, and log the schema.

        Raises:
            NotReady: There are rows, so there was a history: to log them as found would vouch for them.
        """
        connection.info[NOTING] = True
        if not inspect(connection).has_table(LEAVES.name) or self.origin(connection) is not None:
            return
        if any(connection.execute(table.in_order.limit(1)).first() for table in logged().values()):
            self._why = REMOVED
            raise NotReady(*REMOVED)
        self.sign_empty(connection)
        take_notes(connection)
        self.log_schema(connection)

    def sign(self, connection: Connection, *, adopt: bool = False) -> str | None:
        """Number the leaves that have no number yet, at most some, and sign the tree that they extend.

        Leaves without a valid seal are left alone: nobody who wrote them had the key, and `skills verify` names them.

        Args:
            connection: In a transaction in which nobody else signs.
            adopt: Take over a history that was signed with another key, with all its leaves.

        Returns:
            The signed checkpoint; None where there is nothing to sign.

        Raises:
            BadSettings: The signing key cannot be read.
            Corrupt: The stored tree is not the one that was signed last; nothing is signed on top of it.
        """
        query = select(LEAVES.c.row, LEAVES.c.entry, LEAVES.c.seal).where(LEAVES.c.number.is_(None))
        query = query.order_by(LEAVES.c.row).limit(None if adopt else SIGNED_AT_ONCE)
        # a leaf that an erasure is changing waits for the next time, so that neither waits for the other
        leaves = connection.execute(query.with_for_update(skip_locked=True)).all()
        if not leaves and not adopt:
            return None
        origin, tree = self._continued(connection, adopt)
        seal = self.key.seal_of(origin)
        numbered = []
        for row, entry, sealed in leaves:
            if adopt or hmac.compare_digest(sealed, seal.of(entry.encode())):
                numbered.append({"of_row": row, "given": tree.size})
                tree.append(leaf_hash(entry.encode()))
        if not numbered and not adopt:
            return None
        if numbered:
            numbering = update(LEAVES).where(LEAVES.c.row == bindparam("of_row")).values(number=bindparam("given"))
            connection.execute(numbering, numbered)
        note = self.key.sign(Checkpoint(origin, tree.size, tree.root))
        stored = {"size": tree.size, "note": note, "subtrees": b"".join(tree.subtrees)}
        connection.execute(insert(CHECKPOINTS), [stored])
        return note

    def _continued(self, connection: Connection, adopt: bool) -> tuple[str, Tree]:
        """Return the log's name and its tree as signed last."""
        columns = (CHECKPOINTS.c.size, CHECKPOINTS.c.note, CHECKPOINTS.c.subtrees)
        size, text_of, hashes = connection.execute(select(*columns).order_by(CHECKPOINTS.c.row.desc()).limit(1)).one()
        (note,) = read_notes(text_of)
        subtrees = [hashes[at : at + HASH_BYTES] for at in range(0, len(hashes), HASH_BYTES)]
        signed = note.checkpoint
        if len(subtrees) == size.bit_count() and (adopt or note.signed_by(self.key.public)):
            tree = Tree(size, subtrees)
            if (signed.origin, signed.size, signed.root) == (self.origin(connection), size, tree.root):
                return signed.origin, tree
        raise Corrupt(
            "The history is not as it was signed last with this signing key, so nothing is signed on top of it.",
            Remedy(Action.VERIFY),
        )

    def sign_empty(self, connection: Connection) -> None:
        """Write the first checkpoint of a new log, of no leaves, with a key that is made if there is none."""
        make_signing_key(self.key_file, self._engine.url)
        empty = Checkpoint(ORIGIN + secrets.token_hex(8), 0, Tree().root)
        connection.execute(insert(CHECKPOINTS), [{"size": 0, "note": self.key.sign(empty), "subtrees": b""}])

    def log_schema(self, connection: Connection) -> None:
        """Log the changes of triggers, indexes and constraints since they were last logged, after a migration."""
        at = rfc3339(now())
        here, known = schema_of(connection), latest_leaves(connection, SCHEMA)
        leaves = []
        for name, sql in here.items():
            before = known.get(name)
            if before is None or not before.matches(("sql",), (sql,)):
                leaves.append(new_leaf(SCHEMA, CHANGE if before else ADD, at, name, {"sql": sql}, before))
        gone = [name for name in known if name not in here]
        self._write(connection, [*leaves, *removals(connection, SCHEMA, gone, known, at)])

    def go_on_after_restore(self, connection: Connection) -> None:
        """Continue the history of a backup in the database that it was just loaded into.

        Its rows were logged before, so the notes of their insertion are dropped. A history that was signed
        with another key goes on with the one of this installation.

        Raises:
            Corrupt: The tree of the backup is not the one that was signed.
        """
        take_notes(connection)
        connection.info[NOTING] = True
        self._origin = self._seal = None
        archive_heads(self.heads_file)  # of a database that was here before
        if self.origin(connection) is None:
            self.begin(connection)
            return
        make_signing_key(self.key_file, self._engine.url)
        if not read_notes(newest_checkpoint(connection) or "")[0].signed_by(self.key.public):
            self.sign(connection, adopt=True)
        self.log_schema(connection)


def make_signing_key(file: Path, url: URL) -> None:
    """Make a signing key that only this user can read, if there is no file of that name.

    Raises:
        BadSettings: The file would be beside the database, or cannot be written.
    """
    if file.exists():
        return
    if url.get_backend_name() == "sqlite":
        beside, around = Path(url.database or "").resolve().parent, file.resolve().parents
        # somebody who keeps the database in the home folder has the state folder below it
        if beside == around[0] or (beside in around and not Path.home().resolve().is_relative_to(beside)):
            raise BadSettings(
                f"The signing key {file} would be in the folder of the database, whose owner could then rewrite "
                "the history.",
                "Name a file in another folder in SKILLS_SIGNING_KEY.",
            )
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{file.name}-", dir=file.parent)  # mode 0600
        with os.fdopen(handle, "w") as out:
            out.write(str(SigningKey(secrets.token_bytes(32))))
            out.flush()
            os.fsync(out.fileno())
        try:
            os.link(name, file)  # unlike a rename it never replaces the key of another process
        except FileExistsError:
            pass
        finally:
            Path(name).unlink()
    except OSError as error:
        raise BadSettings(
            f"The signing key {file} cannot be made: {error.strerror}.", "Name another file in SKILLS_SIGNING_KEY."
        ) from error
