"""Statements about files, signed with the key of the service, which are verified without the service.

    digests of files, facts --attest--> envelope --read_envelope--> Envelope --statement_by(key)--> Statement

A statement is an in-toto Statement (version 1): its subjects are the SHA-256 digests of files, its predicate has facts
about them. It is signed as a DSSE envelope (Dead Simple Signing Envelope, version 1) with the Ed25519 key that signs
the history, so that tools for either verify it. The signature covers the bytes `pae`, which begin with "DSSEv1", and no
checkpoint begins so: a signature of the one is never one of the other.
"""

import base64
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from skills.errors import BadSignature, Corrupt
from skills.packing import canonical
from skills.transparency import PublicKey, SigningKey

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
