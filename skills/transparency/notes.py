"""Signed checkpoints as texts: C2SP signed notes whose text is a tlog-checkpoint (origin, number of leaves, root).

Checkpoint --SigningKey.sign--> signed note --read_notes--> Note
"""

import base64
import binascii
import re
from dataclasses import dataclass

from skills.errors import Corrupt
from skills.transparency.merkle import Checkpoint
from skills.transparency.signing_keys import KEY_ID_BYTES, PublicKey, key_id

_NOTE = re.compile(
    r"^(?P<origin>[^\s+]+)\n(?P<size>0|[1-9]\d{0,18})\n(?P<root>[A-Za-z0-9+/]{43}=)\n\n"
    r"(?P<signed>(?:\u2014 [^\s+]+ [A-Za-z0-9+/=]+\n)+)",
    re.MULTILINE,
)


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
