"""The database: tables whose rows label values, sessions and transactions, serialisation, and backups.

Here are the definitions that all tables share: names of constraints, UTC timestamps, digests, row numbers, and the
query of the newest rows.

models           the tables of the library
service_tables   the tables of the service: jobs with their datasets, workers, keys, sign-ins, the audit log
session          sessions and their errors
engines          opening a database
disk             private files; a full and a failed disk
revisions        the version of the tables, and their migrations
packed           values in one column: serialised without pickle, and verified at every read
history          the log of all changes, written with them
change_notes     the rows that a transaction has changed, noted by triggers
logged_rows      the tables and columns that the history logs, each as the bytes that its digest covers
leaves           the leaves of the history, and the checkpoints over them
tiles            the inner hashes of its tree, stored by 256
saved_heads      its signed heads, in a file outside the database
row_visibility   rules that restrict a caller's queries to some surgeons
changes          change detection for caches, without reading a table
weighted_cache   a least-recently-used cache for several threads
dump             backups
"""

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Annotated, Any, Generic, TypeVar

import sqlalchemy as sa
from pydantic import TypeAdapter, ValidationError
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column
from sqlalchemy.sql.operators import OperatorType
from sqlalchemy.types import JSON, TypeDecorator, TypeEngine

from skills.errors import Corrupt

T = TypeVar("T")
N = TypeVar("N", bound="Numbered")

NAMES = {
    "ix": "ix_%(column_0_label)s",
    "uq": "uq_%(table_name)s_%(column_0_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s",
    "pk": "pk_%(table_name)s",
}

Sha256 = sa.String(64)
Slug = sa.String(64)
PARAMETERS = 10_000  # ours: per statement, well below the limit of either database


def now() -> datetime:
    """Return the current time in UTC."""
    return datetime.now(UTC)


class Moment(TypeDecorator[datetime]):
    """A column of UTC timestamps on every database.

    A timestamp without time zone is a programming error, which is asserted: SQLite would store it unchecked.
    """

    impl = sa.DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: sa.Dialect) -> datetime | None:
        """Convert to UTC before storing."""
        if value is None:
            return None
        assert value.tzinfo is not None, "times must have a time zone"
        return value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: sa.Dialect) -> datetime | None:
        """Return the timestamp in UTC; SQLite returns it without its time zone."""
        return value if value is None else value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class AsJson(TypeDecorator[T], Generic[T]):
    """A column of JSON that is written from a value of one type, and checked by pydantic at every read.

    The type is a model of `skills.schemas`, or any other type that pydantic knows. Parts can be selected in queries, as
    of a column of plain JSON.
    """

    impl = JSON
    cache_ok = True

    def __init__(self, kind: type[T]) -> None:
        super().__init__(none_as_null=True)
        self.kind = kind
        self._adapter = TypeAdapter(kind)

    def process_bind_param(self, value: T | None, dialect: sa.Dialect) -> Any:
        """Return plain JSON."""
        return None if value is None else self._adapter.dump_python(value, mode="json")

    def process_result_value(self, value: Any, dialect: sa.Dialect) -> T | None:
        """Return the value.

        Raises:
            Corrupt: The stored JSON is not one of this type.
        """
        try:
            return None if value is None else self._adapter.validate_python(value)
        except ValidationError as error:
            raise Corrupt(f"A stored {self.kind.__name__} has a form that this version does not know.") from error

    def coerce_compared_value(self, op: OperatorType | None, value: Any) -> TypeEngine[Any]:
        """Return the type of what a part of the column is compared with: plain JSON."""
        return self.impl_instance


class Base(DeclarativeBase):
    """The declarative base class of all tables."""

    metadata = sa.MetaData(naming_convention=NAMES)
    type_annotation_map = {  # noqa: RUF012 - SQLAlchemy reads it from the class
        datetime: Moment,
        dict[str, Any]: JSON,
        list[Any]: JSON,
        str: sa.String(200),
    }


# Columns stand in the order row, digest, those of the table, and time of creation, whatever class declares them.
ROW = sa.BigInteger().with_variant(sa.Integer, "sqlite")
RowId = Annotated[int, mapped_column(ROW, primary_key=True, autoincrement=True, sort_order=-2)]
Number = Annotated[int, mapped_column(ROW)]  # a row, without a foreign key


class Numbered(Base):
    """The base class of tables whose rows are numbered; a number is never used again."""

    __abstract__ = True

    row: Mapped[RowId]


def newest(of: type[N], *which: sa.ColumnElement[bool], limit: int = 1, before: int | None = None) -> sa.Select[N]:
    """Return the query of the newest rows that meet some conditions, the newest first: those before a row, if given."""
    query = sa.select(of).where(*which).order_by(of.row.desc()).limit(limit)
    return query if before is None else query.where(of.row < before)


class Dated(Numbered):
    """The base class of tables whose rows have the time of their creation."""

    __abstract__ = True

    created_at: Mapped[datetime] = mapped_column(default=now, sort_order=1)


class Identified(Dated):
    """The base class of tables whose rows are identified by a SHA-256 in hex, of the value that they label."""

    __abstract__ = True

    sha256: Mapped[str] = mapped_column(Sha256, unique=True, sort_order=-1)


def partial_index(name: str, *columns: str, where: str, unique: bool = False) -> sa.Index:
    """Return an index of the rows that meet a condition, on either database."""
    return sa.Index(name, *columns, unique=unique, sqlite_where=sa.text(where), postgresql_where=sa.text(where))


def in_parts(values: Sequence[T], most: int | None = None) -> Iterator[Sequence[T]]:
    """Split values into batches, by default for `IN` clauses.

    A statement has at most 32,766 parameters on SQLite and 65,535 on PostgreSQL.
    """
    step = most or PARAMETERS
    for at in range(0, len(values), step):
        yield values[at : at + step]


def rfc3339(moment: datetime | None) -> str | None:
    """Return a timestamp in UTC as RFC 3339 text; None for None."""
    return None if moment is None else moment.isoformat().replace("+00:00", "Z")
