"""Merkle trees over log entries, signed checkpoints of them, as transparency logs use, and signed statements on files.

    entries --leaf_hash--> Tree --checkpoint--> Checkpoint --SigningKey.sign--> signed note --open_note--> Checkpoint

The hashes are those of RFC 6962: a leaf is SHA-256(0x00 || entry), a node SHA-256(0x01 || left || right). A checkpoint
is the text of the C2SP specification tlog-checkpoint (the log's origin, the number of leaves, the root), signed as a
C2SP signed note with Ed25519, so that tools for other transparency logs can verify it.

The inner hashes are kept in tiles of the C2SP specification tlog-tiles: tile n of level l has the hashes of the 256
complete subtrees 256 n to 256 n + 255 of 256**l leaves each, and the root of the tile is one hash of level l + 1.

Statements about files are signed with the same key, and verified without the service:

    digests of files, facts --attest--> envelope --read_envelope--> Envelope --statement_by(key)--> Statement

A statement is an in-toto Statement (version 1): its subjects are the SHA-256 digests of files, its predicate has facts
about them. It is signed as a DSSE envelope (Dead Simple Signing Envelope, version 1) with the Ed25519 key that signs
the history, so that tools for either verify it. The signature covers the bytes `pae`, which begin with "DSSEv1", and no
checkpoint begins so: a signature of the one is never one of the other.
"""

import base64
import binascii
import hashlib
import hmac
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from skills.errors import BadSignature, Corrupt
from skills.packing import canonical

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

ED25519 = b"\x01"  # the signature type of a signed note
KEY_ID_BYTES, SEED_BYTES, HASH_BYTES = 4, 32, 32
TILE_HEIGHT = 8  # of the specification tlog-tiles
TILE_WIDTH = 1 << TILE_HEIGHT
KEY_NAME = "suture-skills"  # in the text of a secret key, which may sign several logs


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


# ---- checkpoints -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Checkpoint:
    """The head of a log: its name, the number of its leaves, and the root of their tree."""

    origin: str
    size: int
    root: bytes

    def __str__(self) -> str:
        """Return the text that is signed."""
        return f"{self.origin}\n{self.size}\n{base64.b64encode(self.root).decode()}\n"


@dataclass(frozen=True)
class Note:
    """A checkpoint with signatures that have not been verified, by name and key id."""

    checkpoint: Checkpoint
    signatures: tuple[tuple[str, bytes, bytes], ...]
    text: str

    def signed_by(self, public: bytes) -> bool:
        """Return whether an Ed25519 public key signed it under the log's name."""
        name = self.checkpoint.origin
        for signer, number, signature in self.signatures:
            if (signer, number) == (name, key_id(name, public)):
                return PublicKey(name, public).signed(str(self.checkpoint).encode(), signature)
        return False


@dataclass(frozen=True)
class PublicKey:
    """The public key of an installation, under the name of its log: it verifies checkpoints and signed statements."""

    origin: str
    key: bytes

    @classmethod
    def read(cls, text: str) -> "PublicKey":
        """Read a key from the text that `str()` returns.

        Raises:
            Corrupt: It is not such a text, or was changed.
        """
        try:
            origin, number, encoded = text.strip().split("+", 2)
            kind_and_key = base64.b64decode(encoded, validate=True)
            key = cls(origin, kind_and_key[1:])
            if (kind_and_key[:1], len(key.key), number) != (ED25519, HASH_BYTES, key.number):
                raise ValueError
        except ValueError as error:
            raise Corrupt(
                "This is not the public key of a service, or it was changed.",
                "Get it again from the service, which gives it with the newest checkpoint of its history.",
            ) from error
        return key

    def __str__(self) -> str:
        """Return the key as text, in the usual form for verifiers of signed notes."""
        return f"{self.origin}+{self.number}+{base64.b64encode(ED25519 + self.key).decode()}"

    @property
    def number(self) -> str:
        """The number by which signatures name this key, in hex."""
        return key_id(self.origin, self.key).hex()

    def signed(self, message: bytes, signature: bytes) -> bool:
        """Return whether a signature is of exactly this message."""
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

        try:
            Ed25519PublicKey.from_public_bytes(self.key).verify(signature, message)
        except InvalidSignature:
            return False
        return True


_NOTE = re.compile(
    r"^(?P<origin>[^\s+]+)\n(?P<size>0|[1-9]\d{0,18})\n(?P<root>[A-Za-z0-9+/]{43}=)\n\n"
    r"(?P<signed>(?:\u2014 [^\s+]+ [A-Za-z0-9+/=]+\n)+)",
    re.MULTILINE,
)


def read_notes(text: str) -> list[Note]:
    """Read one or more signed checkpoints that follow each other in a text.

    Raises:
        Corrupt: The text has anything else, or nothing.
    """
    notes = [_note(found) for found in _NOTE.finditer(text)]
    if not notes or _NOTE.sub("", text).strip():
        raise Corrupt(
            "This is not a signed checkpoint of a history.", "Name a file of checkpoints as the service wrote them."
        )
    return notes


def _note(found: re.Match[str]) -> Note:
    signatures = []
    for line in found["signed"].splitlines():
        _, name, encoded = line.split(" ")
        try:
            said = base64.b64decode(encoded, validate=True)
        except binascii.Error:
            continue  # a line that no key of ours wrote
        signatures.append((name, said[:KEY_ID_BYTES], said[KEY_ID_BYTES:]))
    root = base64.b64decode(found["root"])
    return Note(Checkpoint(found["origin"], int(found["size"]), root), tuple(signatures), found[0])


def key_id(name: str, public: bytes) -> bytes:
    """Return the number by which a signed note names an Ed25519 key."""
    return hashlib.sha256(name.encode() + b"\n" + ED25519 + public).digest()[:KEY_ID_BYTES]


class SigningKey:
    """The secret key of an installation: it signs checkpoints, and seals entries that are not yet under one."""

    def __init__(self, seed: bytes) -> None:
        assert len(seed) == SEED_BYTES
        self._seed = seed

    @classmethod
    def read(cls, text: str) -> "SigningKey":
        """Read the key from the text that `str()` returns.

        Raises:
            Corrupt: It is not such a text.
        """
        try:
            word, kind, name, number, encoded = text.strip().split("+", 4)
            kind_and_seed = base64.b64decode(encoded, validate=True)
            key = cls(kind_and_seed[1:])
            if (
                (word, kind, name) != ("PRIVATE", "KEY", KEY_NAME)
                or kind_and_seed[:1] != ED25519
                or number != key._number
            ):
                raise ValueError
        except (ValueError, AssertionError) as error:
            raise Corrupt("This is not a signing key, or it was changed.", "Put the file of the key back.") from error
        return key

    def __str__(self) -> str:
        """Return the key as text, in the usual form of keys for signed notes."""
        return f"PRIVATE+KEY+{KEY_NAME}+{self._number}+{base64.b64encode(ED25519 + self._seed).decode()}\n"

    def __repr__(self) -> str:
        """Return the class alone: a secret must not appear in a log."""
        return "SigningKey()"

    @property
    def _number(self) -> str:
        return key_id(KEY_NAME, self.public).hex()

    @cached_property
    def _private(self) -> "Ed25519PrivateKey":
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # slow, and rarely needed

        return Ed25519PrivateKey.from_private_bytes(self._seed)

    @cached_property
    def public(self) -> bytes:
        """The public key, 32 bytes."""
        return self._private.public_key().public_bytes_raw()

    def verifier(self, origin: str) -> str:
        """Return the public key for a log as text, in the usual form for verifiers of signed notes."""
        return str(PublicKey(origin, self.public))

    def sign(self, checkpoint: Checkpoint) -> str:
        """Return the checkpoint as a signed note."""
        text = str(checkpoint)
        signature = key_id(checkpoint.origin, self.public) + self.signature_of(text.encode())
        return f"{text}\n\u2014 {checkpoint.origin} {base64.b64encode(signature).decode()}\n"

    def signature_of(self, message: bytes) -> bytes:
        """Return the signature of a message, 64 bytes, the same each time."""
        return self._private.sign(message)

    def seal_of(self, origin: str) -> "Seal":
        """Return the seal of one log."""
        return Seal(hmac.digest(self._seed, b"suture-skills seal\n" + origin.encode(), "sha256"))


@dataclass(frozen=True, repr=False)
class Seal:
    """The secret with which a process marks the entries that it wrote itself."""

    secret: bytes

    def of(self, entry: bytes) -> bytes:
        """Return the seal of an entry, 32 bytes."""
        return hmac.digest(self.secret, entry, "sha256")


PAYLOAD_TYPE = "application/vnd.in-toto+json"
STATEMENT = "https://in-toto.io/Statement/v1"
PREDICATE = "urn:suture-skills:signed:1"
LONGEST = 1 << 20  # bytes of an envelope: one of a bag has 3 kB
_SHA256 = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True)
class Statement:
    """The statement in an envelope: the SHA-256 of each file in hex, by name, and facts about the files."""

    subjects: Mapping[str, str]
    facts: Mapping[str, Any]


@dataclass(frozen=True)
class Envelope:
    """An envelope whose signatures have not been verified: the bytes that it holds, and signatures by key id."""

    payload: bytes
    signatures: tuple[tuple[str, bytes], ...]

    @property
    def signers(self) -> str:
        """The ids of the keys that it names."""
        return ", ".join(number for number, _ in self.signatures)

    def statement_by(self, key: PublicKey) -> Statement:
        """Return the statement, if this key signed it.

        Raises:
            BadSignature: The key did not sign it, or it was changed.
        """
        message = pae(PAYLOAD_TYPE, self.payload)
        if not any(key.signed(message, signature) for number, signature in self.signatures if number == key.number):
            raise BadSignature(
                f"The signature is not of the key {key.number}, or what it covers was changed.",
                "Get the file and its signature again from the service that has this key.",
                signers=self.signers,
            )
        return self.statement

    @property
    def statement(self) -> Statement:
        """The statement, whoever signed it.

        Raises:
            Corrupt: It has another form than `attest` writes.
        """
        try:
            said = json.loads(self.payload)
            subjects = {one["name"]: one["digest"]["sha256"] for one in said["subject"]}
            form = (said["_type"], said["predicateType"], type(said["subject"]), len(subjects), type(said["predicate"]))
            if form != (STATEMENT, PREDICATE, list, len(said["subject"]), dict):
                raise ValueError
            if not all(isinstance(name, str) and _SHA256.fullmatch(digest) for name, digest in subjects.items()):
                raise ValueError
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise Corrupt(*UNREADABLE) from error
        return Statement(subjects, said["predicate"])


UNREADABLE = "This is not a signature as the service writes it.", "Get it again from the service."


def pae(payload_type: str, payload: bytes) -> bytes:
    """Return the bytes that a signature covers (DSSE's pre-authentication encoding)."""
    return b"DSSEv1 %d %s %d %s" % (len(payload_type), payload_type.encode(), len(payload), payload)


def attest(subjects: Mapping[str, str], facts: Mapping[str, Any], key: SigningKey, origin: str) -> bytes:
    """Return a signed envelope as JSON; the same statement gives the same bytes.

    Args:
        subjects: The SHA-256 of each file in hex, by name.
        facts: The predicate, as plain JSON.
        key: The key of the installation.
        origin: The name of its log, under which the key is known.
    """
    statement = {
        "_type": STATEMENT,
        "subject": [{"name": name, "digest": {"sha256": digest}} for name, digest in sorted(subjects.items())],
        "predicateType": PREDICATE,
        "predicate": dict(facts),
    }
    payload = canonical(statement)
    signature = key.signature_of(pae(PAYLOAD_TYPE, payload))
    envelope = {
        "payloadType": PAYLOAD_TYPE,
        "payload": base64.b64encode(payload).decode(),
        "signatures": [
            {"keyid": PublicKey(origin, key.public).number, "sig": base64.b64encode(signature).decode()},
        ],
    }
    return json.dumps(envelope, indent=1).encode() + b"\n"


def read_envelope(text: bytes) -> Envelope:
    """Read an envelope.

    Raises:
        Corrupt: It is not one.
    """
    try:
        if len(text) > LONGEST:
            raise ValueError
        said = json.loads(text)
        if said["payloadType"] != PAYLOAD_TYPE:
            raise ValueError
        payload = base64.b64decode(said["payload"], validate=True)
        signatures = [(str(one["keyid"]), base64.b64decode(one["sig"], validate=True)) for one in said["signatures"]]
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise Corrupt(*UNREADABLE) from error
    return Envelope(payload, tuple(signatures))
