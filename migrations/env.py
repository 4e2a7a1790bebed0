"""Where Alembic meets our tables. It is called with an open connection, by `Database.migrate` or a test."""

from alembic import context
from sqlalchemy.schema import SchemaItem

from skills.db import (
    Base,
    service_tables,  # noqa: F401 - declares all tables, with those of the library
)


def ours(_item: SchemaItem, name: str | None, kind: str, _reflected: bool, _compared: SchemaItem | None) -> bool:
    """Leave alone what is not ours: the job engine's tables stand in a schema of their own."""
    return kind != "table" or name in Base.metadata.tables


context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    include_object=ours,
    render_as_batch=True,
    compare_type=False,
    transactional_ddl=True,  # also on SQLite, where Alembic does not take it for granted: all revisions or none
)
with context.begin_transaction():
    context.run_migrations()
