"""Signed statements: DSSE envelopes of in-toto Statements, against a check that shares no code with the package."""

import base64
import hashlib
import json
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as some

from skills.errors import BadSignature, Corrupt
from skills.transparency.merkle import Checkpoint, Tree
from skills.transparency.signing_keys import PublicKey, SigningKey
from skills.transparency.statements import LONGEST, Statement, attest, pae, read_envelope
from tests.independent_history import check_envelope

KEY, ORIGIN = SigningKey(bytes(range(32))), "suture-skills/0123456789abcdef"
PUBLIC = PublicKey.read(KEY.verifier(ORIGIN))
FILES = {"policy.json": hashlib.sha256(b"policy").hexdigest(), "policy.npz": hashlib.sha256(b"arrays").hexdigest()}
FACTS = {"kind": "policy", "version": 3, "surgeon": "kestrel"}
SIGNED = attest(FILES, FACTS, KEY, ORIGIN)


def test_the_example_of_the_specification_is_encoded_as_it_says():
    assert pae("http://example.com/HelloWorld", b"hello world") == (
        b"DSSEv1 29 http://example.com/HelloWorld 11 hello world"
    )


def test_a_statement_is_read_back_and_checked_by_others():
    assert read_envelope(SIGNED).statement_by(PUBLIC) == Statement(FILES, FACTS)
    said = check_envelope(SIGNED, str(PUBLIC))
    assert {one["name"]: one["digest"]["sha256"] for one in said["subject"]} == FILES
    assert said["predicate"] == FACTS
    assert attest(dict(reversed(FILES.items())), FACTS, KEY, ORIGIN) == SIGNED


def test_another_key_or_name_is_refused():
    for key, origin in ((SigningKey(bytes(32)), ORIGIN), (KEY, "suture-skills/another")):
        with pytest.raises(BadSignature, match=PUBLIC.number):
            read_envelope(attest(FILES, FACTS, key, origin)).statement_by(PUBLIC)


def test_a_signed_checkpoint_is_no_signature_of_a_statement():
    """Both are of one key: nothing that it signs as the one may be taken for the other."""
    note = KEY.sign(Checkpoint(ORIGIN, 0, Tree().root))
    _, _, signature = base64.b64decode(note.split()[-1]).partition(bytes.fromhex(PUBLIC.number))
    text = note.rpartition("\n\n")[0].encode() + b"\n"
    assert PUBLIC.signed(text, signature)
    said = json.loads(SIGNED)
    said["payload"] = base64.b64encode(text).decode()
    said["signatures"][0]["sig"] = base64.b64encode(signature).decode()
    with pytest.raises(BadSignature):
        read_envelope(json.dumps(said).encode()).statement_by(PUBLIC)


@given(some.integers(0, 8 * len(SIGNED) - 1))
def test_a_flipped_bit_of_an_envelope_changes_nothing_that_is_believed(bit: int):
    flipped = bytearray(SIGNED)
    flipped[bit // 8] ^= 1 << bit % 8
    with suppress(BadSignature, Corrupt):
        assert read_envelope(bytes(flipped)).statement_by(PUBLIC) == Statement(FILES, FACTS)


def signed(payload: object, payload_type: str = "application/vnd.in-toto+json") -> bytes:
    """Return an envelope with a right signature of any payload."""
    text = json.dumps(payload).encode()
    signature = {"keyid": PUBLIC.number, "sig": base64.b64encode(KEY.signature_of(pae(payload_type, text))).decode()}
    body = {"payloadType": payload_type, "payload": base64.b64encode(text).decode(), "signatures": [signature]}
    return json.dumps(body).encode()


WHOLE = json.loads(base64.b64decode(read_envelope(SIGNED).payload))


@pytest.mark.parametrize(
    "payload",
    [
        None,
        [],
        WHOLE | {"_type": "https://in-toto.io/Statement/v0.1"},
        WHOLE | {"predicateType": "https://slsa.dev/provenance/v1"},
        WHOLE | {"predicate": None},
        WHOLE | {"subject": {}},
        WHOLE | {"subject": [*WHOLE["subject"], WHOLE["subject"][0]]},
        WHOLE | {"subject": [{"name": "policy.json", "digest": {"sha512": "0" * 128}}]},
        WHOLE | {"subject": [{"name": "policy.json", "digest": {"sha256": "F" * 64}}]},
    ],
)
def test_a_statement_of_another_form_is_refused_whoever_signed_it(payload: object):
    with pytest.raises(Corrupt):
        read_envelope(signed(payload)).statement_by(PUBLIC)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b"{",
        b"[" * 100_000,
        b"\xff",
        SIGNED + b" " * LONGEST,
        signed(WHOLE, "application/json"),
        json.dumps(json.loads(SIGNED) | {"payload": "*"}).encode(),
        json.dumps(json.loads(SIGNED) | {"signatures": [3]}).encode(),
    ],
)
def test_an_envelope_that_is_none_is_refused(text: bytes):
    with pytest.raises(Corrupt):
        read_envelope(text)


def test_an_envelope_without_signatures_is_of_nobody():
    with pytest.raises(BadSignature):
        read_envelope(json.dumps(json.loads(SIGNED) | {"signatures": []}).encode()).statement_by(PUBLIC)


@pytest.mark.parametrize("text", ["", "a+b", str(PUBLIC)[:-4], str(PUBLIC).replace("0123", "0124"), str(KEY)])
def test_a_public_key_that_is_none_or_was_changed_is_refused(text: str):
    with pytest.raises(Corrupt, match="not the public key"):
        PublicKey.read(text)
