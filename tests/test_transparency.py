"""Merkle trees, their proofs and signed checkpoints, against RFC 6962 and a check that shares no code."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as some

from skills.db.logged_rows import compact
from skills.errors import Corrupt
from skills.packing import canonical
from skills.transparency.merkle import (
    TILE_WIDTH,
    Checkpoint,
    Tree,
    inclusion_proof,
    leaf_hash,
    node_from,
    node_hash,
    proven_root,
    root_of,
)
from skills.transparency.notes import read_notes
from skills.transparency.signing_keys import SigningKey
from tests.independent_history import check_inclusion, root_in

# The published test data of Certificate Transparency: eight entries, and the root after each.
ENTRIES = [bytes.fromhex(one) for one in (
    "", "00", "10", "2021", "3031", "40414243", "5051525354555657", "606162636465666768696a6b6c6d6e6f",
)]  # fmt: skip
ROOTS = {
    1: "6e340b9cffb37a989ca544e6bb780a2c78901d3fb33738768511a30617afa01d",
    2: "fac54203e7cc696cf0dfcb42c92a1d9dbaf70ad9e621f4bd8d98662f00e3c125",
    3: "aeb6bcfe274b70a14fb067a5e5578264db0fa9b51af5e0ba159158f329e06e77",
    4: "d37ee418976dd95753c1c73862b9398fa2a2cf9b4ff0fdfe8b30cd95209614b7",
    5: "4e3bbb1f7b478dcfe71fb631631519a3bca12c9aefca1612bfce4c13a86264d4",
    6: "76e67dadbcdf1e10e1b74ddc608abd2f98dfb16fbce75277b5232a127f2087ef",
    7: "ddb89be403809e325750d3d263cd78929c2942b7942a34b77e122c9594a74c8c",
    8: "5dc9da79a70659a9ad559cb701ded9a2ab9d823aad2f4960cfe370eff4604328",
}
KEY = SigningKey(bytes(range(32)))
ORIGIN = "suture-skills/0123456789abcdef"


def by_definition(leaves: list[bytes]) -> bytes:
    """Return the root as RFC 6962 defines it, by recursion."""
    if len(leaves) < 2:
        return leaves[0] if leaves else hashlib.sha256().digest()
    half = 1 << (len(leaves) - 1).bit_length() - 1
    return node_hash(by_definition(leaves[:half]), by_definition(leaves[half:]))


def test_the_roots_of_certificate_transparency_come_out():
    for size, root in ROOTS.items():
        assert root_of(map(leaf_hash, ENTRIES[:size])).hex() == root


@given(some.integers(0, 300))
def test_a_growing_tree_has_the_root_of_the_definition(size: int):
    leaves = [leaf_hash(bytes([number % 256, number // 256])) for number in range(size)]
    half = Tree()
    for leaf in leaves[: size // 2]:
        half.append(leaf)
    again = Tree(half.size, half.subtrees)  # as read from a row
    for leaf in leaves[size // 2 :]:
        again.append(leaf)
    assert again.root == by_definition(leaves)


@given(some.integers(1, 70), some.data())
def test_every_leaf_is_proven_and_no_other_entry(size: int, data: some.DataObject):
    entries = [f"entry {number}" for number in range(size)]
    leaves = [leaf_hash(entry.encode()) for entry in entries]
    number = data.draw(some.integers(0, size - 1))
    note = KEY.sign(Checkpoint(ORIGIN, size, root_of(leaves)))
    proof = inclusion_proof(size, number, lambda height, at: by_definition(leaves[at << height : at + 1 << height]))
    assert proven_root(leaves[number], number, size, proof) == root_of(leaves)
    assert proven_root(leaves[number], number, size, [*proof, proof[0] if proof else b""]) is None
    check_inclusion(entries[number], number, proof, note, KEY.verifier(ORIGIN))
    with pytest.raises(AssertionError):
        check_inclusion("another", number, proof, note, KEY.verifier(ORIGIN))
    if size > 1:
        with pytest.raises(AssertionError):
            check_inclusion(entries[number], (number + 1) % size, proof, note, KEY.verifier(ORIGIN))


def test_a_proof_of_a_large_tree_comes_from_a_few_tiles():
    leaves = [leaf_hash(b"%d" % number) for number in range(70_000)]
    levels, read = [leaves], set[tuple[int, int]]()
    while len(levels[-1]) >= TILE_WIDTH:
        full = range(0, len(levels[-1]) - TILE_WIDTH + 1, TILE_WIDTH)
        levels.append([root_of(levels[-1][at : at + TILE_WIDTH]) for at in full])

    def tiles(level: int, begin: int, end: int) -> list[bytes]:
        assert begin // TILE_WIDTH == (end - 1) // TILE_WIDTH and end <= len(levels[level])
        read.add((level, begin // TILE_WIDTH))
        return levels[level][begin:end]

    root = root_of(leaves)
    for number in (0, 255, 256, 65_535, 65_536, 69_887, 69_888, 69_999):
        read.clear()
        proof = inclusion_proof(len(leaves), number, node_from(tiles))
        assert proven_root(leaves[number], number, len(leaves), proof) == root
        assert proven_root(leaves[number - 1], number, len(leaves), proof) != root
        assert len(read) <= 5


def test_a_signed_checkpoint_is_read_back_and_checked_by_others():
    checkpoint = Checkpoint(ORIGIN, 8, bytes.fromhex(ROOTS[8]))
    signed = KEY.sign(checkpoint)
    (note,) = read_notes(signed)
    assert note.checkpoint == checkpoint
    assert note.signed_by(KEY.public)
    assert root_in(signed, KEY.verifier(ORIGIN)) == (8, checkpoint.root)
    assert not note.signed_by(SigningKey(bytes(32)).public)
    (forged,) = read_notes(signed.replace("\n8\n", "\n9\n"))
    assert not forged.signed_by(KEY.public)
    with pytest.raises(AssertionError):
        root_in(signed.replace("\n8\n", "\n9\n"), KEY.verifier(ORIGIN))


def test_a_file_of_checkpoints_is_read_whole_or_refused():
    notes = [KEY.sign(Checkpoint(ORIGIN, size, bytes.fromhex(root))) for size, root in ROOTS.items()]
    assert [note.checkpoint.size for note in read_notes("\n".join(notes))] == [*ROOTS]
    for text in ("", "no checkpoint", notes[0] + "more", notes[0][:-30], notes[0].replace("\n1\n", "\n01\n")):
        with pytest.raises(Corrupt):
            read_notes(text)


def test_a_key_is_read_from_its_text_and_never_shown():
    assert SigningKey.read(str(KEY)).public == KEY.public
    assert repr(KEY) == "SigningKey()"
    for text in ("", "PRIVATE+KEY", str(KEY).replace("suture", "other"), str(KEY)[:-9] + "\n"):
        with pytest.raises(Corrupt):
            SigningKey.read(text)


ASCII = some.text(some.characters(max_codepoint=126))


@given(some.dictionaries(ASCII, ASCII | some.none()))
def test_what_is_hashed_of_a_row_is_its_canonical_form(texts):
    assert compact(texts).encode() == canonical(texts)
