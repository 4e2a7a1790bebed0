"""A check of the history's proofs that shares no code with the package: RFC 6962, C2SP signed notes, Ed25519."""

import base64
import hashlib
import json
from typing import Any

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey


def root_in(note: str, verifier: str) -> tuple[int, bytes]:
    """Return size and root of a signed checkpoint, after checking its signature by a verifier's key."""
    name, number, encoded = verifier.split("+", 2)
    public = base64.b64decode(encoded)
    assert public[:1] == b"\x01"
    assert hashlib.sha256(name.encode() + b"\n" + public).hexdigest()[:8] == number
    body, _, signatures = note.rpartition("\n\n")
    for line in signatures.splitlines():
        dash, signer, blob = line.split(" ")
        said = base64.b64decode(blob)
        if (dash, signer, said[:4].hex()) == ("\u2014", name, number):
            try:
                Ed25519PublicKey.from_public_bytes(public[1:]).verify(said[4:], f"{body}\n".encode())
            except InvalidSignature as error:
                raise AssertionError("the signature is wrong") from error
            origin, size, root = body.split("\n")
            assert origin == name
            return int(size), base64.b64decode(root)
    raise AssertionError("the key did not sign it")


def check_inclusion(entry: str, number: int, proof: list[bytes], note: str, verifier: str) -> None:
    """Assert that an entry is the leaf of this number under a signed checkpoint."""
    size, root = root_in(note, verifier)
    assert 0 <= number < size
    node, last = hashlib.sha256(b"\0" + entry.encode()).digest(), size - 1
    for beside in proof:
        assert last > 0, "the proof is too long"
        if number % 2 == 1 or number == last:
            node = hashlib.sha256(b"\1" + beside + node).digest()
            while number % 2 == 0 and number:
                number, last = number // 2, last // 2
        else:
            node = hashlib.sha256(b"\1" + node + beside).digest()
        number, last = number // 2, last // 2
    assert last == 0, "the proof is too short"
    assert node == root, "the entry is not under the checkpoint"


def check_envelope(envelope: bytes, verifier: str) -> dict[str, Any]:
    """Return the in-toto Statement in a DSSE envelope, after checking its signature by a verifier's key."""
    said = json.loads(envelope)
    name, number, encoded = verifier.split("+", 2)
    kind, payload = said["payloadType"].encode(), base64.b64decode(said["payload"])
    covered = b"DSSEv1 " + b" ".join([str(len(kind)).encode(), kind, str(len(payload)).encode(), payload])
    (signature,) = [one["sig"] for one in said["signatures"] if one["keyid"] == number]
    Ed25519PublicKey.from_public_bytes(base64.b64decode(encoded)[1:]).verify(base64.b64decode(signature), covered)
    statement: dict[str, Any] = json.loads(payload)
    assert statement["_type"] == "https://in-toto.io/Statement/v1"
    assert statement["predicate"].get("checkpoint", name).partition("\n")[0] == name
    return statement


def check_disclosed(proof: dict[str, Any], note: str, verifier: str) -> dict[str, Any]:
    """Return the disclosed columns of a row, after checking them down to a signed checkpoint."""
    salt, values = bytes.fromhex(proof["salt"]), {}
    for name, said in proof["disclosed"].items():
        digest = hashlib.sha256(salt + name.encode() + b"\0" + said.encode()).hexdigest()[:32]
        assert digest == proof["digests"][name], f"{name} is not as it was logged"
        values[name] = None if said == "none" else json.loads(said[4:]) if said[:4] == "json" else said[6:]
    entry = json.loads(proof["entry"])
    digests = json.dumps(proof["digests"], sort_keys=True, separators=(",", ":"))
    assert hashlib.sha256(digests.encode()).hexdigest() == entry["commitment"], "the digests are not those of the entry"
    assert entry["table"] == proof["table"]
    hashes = [bytes.fromhex(one) for one in proof["hashes"]]
    check_inclusion(proof["entry"], proof["number"], hashes, note, verifier)
    return values
