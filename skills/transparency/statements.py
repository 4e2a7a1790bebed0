"""Signed statements about files, verified without the service.

    digests of files, facts --attest--> envelope --read_envelope--> SignedEnvelope --statement_by(key)--> Statement

A statement is an in-toto Statement (version 1): its subjects are the SHA-256 digests of files, its predicate has facts
about them. It is signed as a DSSE envelope (Dead Simple Signing Envelope, version 1) with the Ed25519 key that signs
the history, so that tools for either verify it. The signature covers the bytes `pae`, which begin with "DSSEv1", and no
checkpoint begins so: a signature of the one is never one of the other.
"""

from base64 import b64decode, b64encode
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, Field

from skills.errors import BadSignature, Corrupt
from skills.fields import Sha256
from skills.packing import canonical
from skills.transparency.signing_keys import PublicKey, SigningKey

STATEMENT = "https://in-toto.io/Statement/v1"
PREDICATE = "urn:suture-skills:signed:1"
LONGEST = 1 << 20  # bytes of an envelope: one of a bag has 3 kB
PAYLOAD_TYPE: Final = "application/vnd.in-toto+json"
UNREADABLE = "This is not a signature as the service writes it.", "Get it again from the service."


def _base64(text: str) -> str:
    b64decode(text, validate=True)  # raises a ValueError
    return text


Base64Text = Annotated[str, AfterValidator(_base64)]


@dataclass(frozen=True)
class Statement:
    """The statement in an envelope: the SHA-256 of each file in hex, by name, and facts about the files."""

    subjects: Mapping[str, str]
    facts: Mapping[str, Any]  # as they are signed: of a bag, a policy or a card


class _Digest(BaseModel):
    sha256: Sha256


class _Subject(BaseModel):
    name: str
    digest: _Digest


class _InTotoStatement(BaseModel):
    """A statement as it is signed."""

    type: Literal["https://in-toto.io/Statement/v1"] = Field(alias="_type")
    subject: list[_Subject]
    predicate_type: Literal["urn:suture-skills:signed:1"] = Field(alias="predicateType")
    predicate: dict[str, Any]


class EnvelopeSignature(BaseModel):
    """A signature in an envelope."""

    keyid: str = Field(description="The number of the key, as in `verifier` of `GET /history/checkpoint`.")
    sig: Base64Text = Field(description="Ed25519 over the payload as DSSE encodes it, in base64.")


class SignedEnvelope(BaseModel):
    """A DSSE envelope with an in-toto Statement: the SHA-256 of files, and what they are, signed by this service.

    The bytes of each file are those of the call that gives it; a file of other bytes is not covered.
    """

    payloadType: Literal["application/vnd.in-toto+json"]  # noqa: N815 - the name in DSSE
    payload: Base64Text = Field(description="The statement as JSON, in base64.")
    signatures: list[EnvelopeSignature]

    @property
    def signers(self) -> str:
        """The ids of the keys that it names."""
        return ", ".join(one.keyid for one in self.signatures)

    def statement_by(self, key: PublicKey) -> Statement:
        """Return the statement, if this key signed it.

        Raises:
            BadSignature: The key did not sign it, or it was changed.
        """
        message = pae(PAYLOAD_TYPE, b64decode(self.payload))
        if not any(key.signed(message, b64decode(one.sig)) for one in self.signatures if one.keyid == key.number):
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
            signed = _InTotoStatement.model_validate_json(b64decode(self.payload))
            subjects = {one.name: one.digest.sha256 for one in signed.subject}
            if len(subjects) < len(signed.subject):
                raise ValueError("a file has two digests")
        except ValueError as error:
            raise Corrupt(*UNREADABLE) from error
        return Statement(subjects, signed.predicate)


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
    payload = canonical(
        {
            "_type": STATEMENT,
            "subject": [{"name": name, "digest": {"sha256": digest}} for name, digest in sorted(subjects.items())],
            "predicateType": PREDICATE,
            "predicate": dict(facts),
        }
    )
    number, signature = PublicKey(origin, key.public).number, key.signature_of(pae(PAYLOAD_TYPE, payload))
    signed = EnvelopeSignature(keyid=number, sig=b64encode(signature).decode())
    envelope = SignedEnvelope(payloadType=PAYLOAD_TYPE, payload=b64encode(payload).decode(), signatures=[signed])
    return envelope.model_dump_json(indent=1).encode() + b"\n"


def read_envelope(text: bytes) -> SignedEnvelope:
    """Read an envelope, whose signatures are not verified yet.

    Raises:
        Corrupt: It is not one.
    """
    try:
        if len(text) > LONGEST:
            raise ValueError("too long")
        return SignedEnvelope.model_validate_json(text)
    except ValueError as error:
        raise Corrupt(*UNREADABLE) from error
