"""Older copies of a database, as somebody makes and puts back who can replace all of it."""

import shutil
import uuid
from contextlib import closing
from pathlib import Path

from sqlalchemy import make_url

from skills.db.session import Database
from tests import backends


def copy_away(url: str) -> str:
    """Copy a database that nobody uses now, and return the URL of the copy."""
    if url.startswith("sqlite"):
        file = Path(url.removeprefix("sqlite:///"))
        with closing(Database(url)) as database:
            database.forget()
        return f"sqlite:///{shutil.copy(file, file.with_suffix(f'.{uuid.uuid4().hex[:8]}'))}"
    name = f"d{uuid.uuid4().hex[:12]}"
    backends.on_server(f"CREATE DATABASE {name} TEMPLATE {make_url(url).database}")
    return backends.server_url(name)


def put_back(copy: str, url: str) -> None:
    """Replace a database by a copy, which is left as it is."""
    if url.startswith("sqlite"):
        file = Path(url.removeprefix("sqlite:///"))
        for suffix in ("-wal", "-shm"):
            file.with_name(f"{file.name}{suffix}").unlink(missing_ok=True)
        shutil.copy(copy.removeprefix("sqlite:///"), file)
        return
    name = make_url(url).database
    backends.on_server(f"DROP DATABASE {name} WITH (FORCE)")
    backends.on_server(f"CREATE DATABASE {name} TEMPLATE {make_url(copy).database}")
