"""The notes of a transaction: the key of every row that it adds, changes or removes, by whatever statement.

Triggers note changed rows until the commit. On SQLite, with one writer, that is in a table. On PostgreSQL it is in
settings of the transaction, which cost no page and end with it: "skills.notes0" and, where there are many, further ones
up to the number in "skills.noting", which only connections of the service have.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

from sqlalchemy import Connection

ADD, CHANGE, REMOVE = "add", "change", "remove"
NOTING = "noting"  # in a connection's `info`: whether its transactions note changes
NOTING_CONNECTION = "-c skills.noting=0"  # for the options of a connection
FORGET_NOTES = "DELETE FROM history_notes"
_TAKEN = {
    "sqlite": "DELETE FROM history_notes RETURNING rowid, table_name, change, key, changed",
    "postgresql": "SELECT current_setting('skills.noting', true), current_setting('skills.notes0', true), "
    "set_config('skills.notes0', '', true)",
}
_FURTHER = (
    "SELECT current_setting('skills.notes' || n, true), set_config('skills.notes' || n, '', true), "
    "set_config('skills.noting', '0', true) FROM generate_series(1, %s) n"
)


@dataclass(frozen=True)
class Effect:
    """Whether a row existed before a transaction, whether it exists after it, and the columns that were changed.

    `written` says that the row was inserted, so all of its columns are the transaction's.
    """

    before: bool
    after: bool
    written: bool
    changed: frozenset[str]


def effects_of(notes: Iterable[tuple[str, str, str, str | None]]) -> dict[str, dict[str, Effect]]:
    """Return the effects of a transaction's notes, by table and key, in the order of their first notes."""
    found: dict[str, dict[str, Effect]] = {}
    for table, change, key, changed in notes:
        of_table = found.setdefault(table, {})
        so_far = of_table.get(key, Effect(change != ADD, True, False, frozenset()))
        columns = so_far.changed.union((changed or "").split())
        of_table[key] = Effect(so_far.before, change != REMOVE, so_far.written or change == ADD, columns)
    return found


def take_notes(connection: Connection) -> list[Any]:
    """Remove and return the notes of the transaction so far: table, change, key and changed columns, in their order."""
    taken = connection.exec_driver_sql(_TAKEN[connection.dialect.name])
    if connection.dialect.name == "sqlite":
        return [note for _, *note in sorted(taken, key=itemgetter(0))]
    last, noted, *_ = taken.one()
    if int(last or 0):
        noted += "".join(part for part, *_ in connection.exec_driver_sql(_FURTHER, (int(last),)))
    return [json.loads(note) for note in noted.splitlines()] if noted else []
