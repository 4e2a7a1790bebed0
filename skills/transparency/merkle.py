"""Merkle trees over the entries of a log, and proofs that an entry is in one.

    entries --leaf_hash--> Tree --root--> Checkpoint
    hashes of subtrees --inclusion_proof--> hashes beside a path --proven_root--> root

The hashes are those of RFC 6962: a leaf is SHA-256(0x00 || entry), a node SHA-256(0x01 || left || right).

The inner hashes are stored in tiles of the C2SP specification tlog-tiles: tile n of level l has the hashes of the 256
complete subtrees 256 n to 256 n + 255 of 256**l leaves each, and the root of the tile is one hash of level l + 1.
"""

import base64
import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

HASH_BYTES = 32
TILE_HEIGHT = 8  # of the specification tlog-tiles
TILE_WIDTH = 1 << TILE_HEIGHT


def leaf_hash(entry: bytes) -> bytes:
    """Return the hash of a log entry."""
    return hashlib.sha256(b"\0" + entry).digest()


def node_hash(left: bytes, right: bytes) -> bytes:
    """Return the hash of a node of the tree."""
    return hashlib.sha256(b"\1" + left + right).digest()


class Tree:
    """A Merkle tree that grows at its end, of which only the roots of the complete subtrees are held.

    The subtrees are the largest ones of which the tree consists from left to right, one for each bit of its size.
    """

    def __init__(self, size: int = 0, subtrees: Sequence[bytes] = ()) -> None:
        assert len(subtrees) == size.bit_count()
        self.size = size
        self.subtrees = list(subtrees)

    def append(self, leaf: bytes) -> None:
        """Add the hash of a leaf."""
        rest = self.size
        while rest & 1:  # each complete subtree of this size becomes the left half of one twice as large
            leaf = node_hash(self.subtrees.pop(), leaf)
            rest >>= 1
        self.subtrees.append(leaf)
        self.size += 1

    @property
    def root(self) -> bytes:
        """The hash of the whole tree."""
        if not self.subtrees:
            return hashlib.sha256().digest()
        *others, root = self.subtrees
        for left in reversed(others):
            root = node_hash(left, root)
        return root


def root_of(leaves: Iterable[bytes]) -> bytes:
    """Return the root of the tree of some leaf hashes."""
    tree = Tree()
    for leaf in leaves:
        tree.append(leaf)
    return tree.root


# ---- proofs from the hashes of complete subtrees ---------------------------------------------------------------------

# The hash of the complete subtree of 2**height leaves that is the index-th of its height, counted from the left.
Node = Callable[[int, int], bytes]
# The hashes begin to end of the complete subtrees of 2**(8 level) leaves, all of one tile.
Tiles = Callable[[int, int, int], Sequence[bytes]]


def node_from(tiles: Tiles) -> Node:
    """Return the hashes of complete subtrees, computed from tiles, each of which may be read several times."""

    def node(height: int, index: int) -> bytes:
        level, rest = divmod(height, TILE_HEIGHT)
        return root_of(tiles(level, index << rest, index + 1 << rest))

    return node


def inclusion_proof(size: int, index: int, node: Node) -> list[bytes]:
    """Return the hashes beside the path from a leaf to the root, from the leaf upwards (RFC 6962, 2.1.1).

    Args:
        size: The number of leaves of the whole tree.
        index: Of the leaf.
        node: The hashes of complete subtrees; it is called for at most log2(size)**2 of them.
    """
    assert 0 <= index < size
    begin, end, proof = 0, size, list[bytes]()
    while end - begin > 1:
        middle = begin + _half(end - begin)
        if index < middle:
            proof.append(_root_between(middle, end, node))
            end = middle
        else:
            proof.append(_root_between(begin, middle, node))
            begin = middle
    return proof[::-1]


def _root_between(begin: int, end: int, node: Node) -> bytes:
    size = end - begin
    if size.bit_count() == 1:
        return node(size.bit_length() - 1, begin // size)
    middle = begin + _half(size)
    return node_hash(_root_between(begin, middle, node), _root_between(middle, end, node))


def _half(size: int) -> int:
    """Return the number of leaves of the left half: the largest power of two below the size."""
    return 1 << (size - 1).bit_length() - 1


def proven_root(leaf: bytes, index: int, size: int, proof: Sequence[bytes]) -> bytes | None:
    """Return the root of the tree in which a proof puts a leaf; None where the proof has too many or too few hashes."""
    beside, last = iter(proof), size - 1
    while last > 0:
        if index % 2 == 1 or index < last:  # otherwise it is the last of its height, and has nothing beside it
            other = next(beside, None)
            if other is None:
                return None
            leaf = node_hash(other, leaf) if index % 2 == 1 else node_hash(leaf, other)
        index, last = index // 2, last // 2
    return leaf if next(beside, None) is None else None


@dataclass(frozen=True)
class Checkpoint:
    """The head of a log: its name, the number of its leaves, and the root of their tree."""

    origin: str
    size: int
    root: bytes

    def __str__(self) -> str:
        """Return the text that is signed."""
        return f"{self.origin}\n{self.size}\n{base64.b64encode(self.root).decode()}\n"
