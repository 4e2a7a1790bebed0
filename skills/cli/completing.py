"""What a shell proposes when Tab is pressed: the surgeons and suture types that there are.

A shell waits for this at every press, so it is given up soon, and whatever goes wrong is nobody's business then.
"""

from collections.abc import Callable
from contextlib import closing, suppress
from threading import Thread

LIMIT_S = 1.5  # ours: longer than a warm answer takes, shorter than somebody waits
MOST = 200


def surgeons(incomplete: str) -> list[str]:
    """Propose surgeons."""
    return _in_time(_surgeons, incomplete)


def sutures(incomplete: str) -> list[str]:
    """Propose suture types."""
    return _in_time(_sutures, incomplete)


def _in_time(find: Callable[[], list[str]], incomplete: str) -> list[str]:
    found: list[str] = []

    def look() -> None:
        with suppress(Exception):
            found.extend(name for name in find() if name.startswith(incomplete))

    thread = Thread(target=look, daemon=True)
    thread.start()
    thread.join(LIMIT_S)
    return list(found)


def _surgeons() -> list[str]:
    return _asked("/surgeons", "surgeon") or _stored("list_surgeons")


def _sutures() -> list[str]:
    return _asked("/suture-types", "suture") or _stored("list_suture_types")


def _asked(path: str, field: str) -> list[str]:
    """Ask the service, where one is set."""
    from skills.settings import settings

    if not settings().server:
        return []
    from skills.client import Client, Retrying

    with Client(str(settings().server), timeout_s=LIMIT_S, retrying=Retrying(attempts=1)) as client:
        return [one[field] for one in client.get_json(path, limit=MOST)["items"]]


def _stored(listing: str) -> list[str]:
    """Look into the database, where one is there and no service is set."""
    from pathlib import Path

    from skills.settings import settings

    url = settings().database_url
    file = url.removeprefix("sqlite:///")
    if settings().server or (file != url and not Path(file).is_file()):
        return []
    from skills.db.session import Database
    from skills.library import catalogue

    with closing(Database(url, patience_ms=int(LIMIT_S * 1000))) as database, database.reading() as session:
        return [row.slug for row in getattr(catalogue, listing)(session, MOST, None)]
