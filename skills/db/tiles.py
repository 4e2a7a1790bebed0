"""The inner hashes of the history's tree in tiles, so that a proof reads a few tiles instead of all leaves.

    leaves --fill_tiles--> rows of 256 hashes --stored_tiles--> the hashes that a proof needs

A tile is written in the transaction that signs its last leaf, and never changes. They are derived from the leaves: a
backup leaves them out, and `skills verify` compares them. Whoever changes one makes proofs fail, and proves nothing.
"""

from collections.abc import Iterator, Sequence
from itertools import count
from typing import cast

from sqlalchemy import BigInteger, Connection, LargeBinary, Table, func, insert, select
from sqlalchemy.orm import Mapped, mapped_column

from skills.db import Base
from skills.db.leaves import CHECKPOINTS, LEAVES
from skills.transparency.merkle import HASH_BYTES, TILE_HEIGHT, TILE_WIDTH, Tiles, leaf_hash, root_of


class Tile(Base):
    """A full tile of the tree: the hashes of 256 subtrees, and their root, which is one hash of the level above."""

    __tablename__ = "history_tiles"

    level: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    number: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    root: Mapped[bytes] = mapped_column(LargeBinary)  # before the hashes: on the first page of the row in SQLite
    hashes: Mapped[bytes] = mapped_column(LargeBinary)


TILES = cast(Table, Tile.__table__)


def fill_tiles(connection: Connection) -> None:
    """Write the full tiles of the signed tree that are not stored yet, in a transaction in which nobody else signs.

    It stops where leaves are missing, which `skills verify` names.
    """
    size: int = connection.scalar(select(CHECKPOINTS.c.size).order_by(CHECKPOINTS.c.row.desc()).limit(1)) or 0
    for level, full in full_tiles(size):
        last: int | None = connection.scalar(select(func.max(TILES.c.number)).where(TILES.c.level == level))
        for number in range(0 if last is None else last + 1, full):
            hashes = _below(connection, level, number * TILE_WIDTH, (number + 1) * TILE_WIDTH)
            if len(hashes) != TILE_WIDTH:
                return
            tile = {"level": level, "number": number, "root": root_of(hashes), "hashes": b"".join(hashes)}
            connection.execute(insert(TILES), [tile])


def full_tiles(size: int) -> Iterator[tuple[int, int]]:
    """Yield each level of a tree of some leaves that has full tiles, with their number."""
    for level in count():
        full = size >> TILE_HEIGHT * (level + 1)
        if not full:
            return
        yield level, full


def stored_tiles(connection: Connection) -> Tiles:
    """Return a function that reads the hashes of subtrees from stored tiles, each tile once.

    Hashes beyond the last full tile of a level are the roots of full tiles of the level below, or those of leaves.
    Where something is missing in the database it returns fewer hashes.
    """
    known: dict[tuple[int, int], Sequence[bytes]] = {}

    def tiles(level: int, begin: int, end: int) -> Sequence[bytes]:
        number, first = begin // TILE_WIDTH, begin // TILE_WIDTH * TILE_WIDTH
        if (level, number) not in known:
            this = (TILES.c.level == level, TILES.c.number == number)
            full: bytes | None = connection.scalar(select(TILES.c.hashes).where(*this))
            if full is None:
                known[level, number] = _below(connection, level, first, first + TILE_WIDTH)
            else:
                known[level, number] = [full[at : at + HASH_BYTES] for at in range(0, len(full), HASH_BYTES)]
        return known[level, number][begin - first : end - first]

    return tiles


def _below(connection: Connection, level: int, begin: int, end: int) -> list[bytes]:
    """Return hashes of a level, computed from the level below: from the leaves, or of the tiles there their roots."""
    if level == 0:
        of_leaf = (LEAVES.c.number >= begin, LEAVES.c.number < end)
        entries = connection.scalars(select(LEAVES.c.entry).where(*of_leaf).order_by(LEAVES.c.number))
        return [leaf_hash(entry.encode()) for entry in entries]
    of_tile = (TILES.c.level == level - 1, TILES.c.number >= begin, TILES.c.number < end)
    return [*connection.scalars(select(TILES.c.root).where(*of_tile).order_by(TILES.c.number))]
