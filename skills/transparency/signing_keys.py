"""The signing key of an installation, its public key, and seals of entries that are not yet under a signature.

A checkpoint is signed as a C2SP signed note with Ed25519, so that tools for other transparency logs can verify it.
"""

import base64
import hashlib
import hmac
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from skills.errors import Corrupt
from skills.transparency.merkle import HASH_BYTES, Checkpoint

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

ED25519 = b"\x01"  # the signature type of a signed note
KEY_ID_BYTES, SEED_BYTES = 4, 32
KEY_NAME = "suture-skills"  # in the text of a secret key, which may sign several logs


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
