"""Two keys that are derived from an access token, and the proof of an order that is made with one. No I/O, no clock.

Whoever holds a token need not show it. He derives from it, and from nothing else:

- the *reading key*, a text that stands in the token's place in `Authorization: Bearer`. It opens what the token may
  look at, and changes nothing.
- the *signing key* (Ed25519), which never leaves him. It signs each order: the HTTP request as it is sent, under a
  challenge that control gave and takes once.

Invariants:

1. The appliance keeps SHA-256 of the reading key and the public half of the signing key (`TokenKeys`). Neither key
   can be made from them: who reads the state, a backup, or all that the api sees of such a client can order nothing.
2. The signed text has seven lines, each a whole part of the request, and no part may have a control character: no
   two requests have the same text.
3. A change of anything here is another version in the first line, in the derivations and in `docs/rest.md`.
"""

import base64
import hashlib
import hmac
import re
from typing import NamedTuple

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

HEADER = "ROSRV-Proof"  # "CHALLENGE SIGNATURE"
_VERSION = "rosrv order 1"
_READING, _SIGNING = b"rosrv reading key 1", b"rosrv signing key 1"
_READING_FORM = re.compile(r"rosrv-read_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")
_PROOF_FORM = re.compile(r"([!-~]{1,200}) ([A-Za-z0-9_-]{86})")


class BadProofError(ValueError):
    """A proof or a request that none can be made for; the text says why."""


class TokenKeys(NamedTuple):
    """What is kept of a token's keys: SHA-256 of the reading key, the public half of the signing key; 32 bytes each."""

    reading: bytes
    verifying: bytes


def keys_of(token: str) -> TokenKeys:
    """What is kept of the keys of a token `rosrv_ID_SECRET`."""
    return TokenKeys(reading_hash(reading_key(token)), _signing_key(token).public_key().public_bytes_raw())


def reading_key(token: str) -> str:
    """The text that a holder shows in the token's place: `rosrv-read_ID_KEY`."""
    token_id = token.split("_")[1]
    return f"rosrv-read_{token_id}_{_text(hmac.digest(token.encode('ascii'), _READING, hashlib.sha256))}"


def reading_id(shown: str) -> str | None:
    """The id in the form of a reading key; None when it is none."""
    found = _READING_FORM.fullmatch(shown)
    return None if found is None else found[1]


def reading_hash(key: str) -> bytes:
    """What is kept of a reading key. It has 256 bits that nobody can guess: a fast hash is enough."""
    return hashlib.sha256(key.encode("ascii")).digest()


def statement(
    challenge: str, *, method: str, target: str, if_match: str, content_type: str, body: bytes
) -> bytes:
    """The text that is signed. `target` is path and query as sent; a header that is missing is empty.

    Raises `BadProofError` for a part with a control character.
    """
    parts = (_VERSION, challenge, method, target, if_match, content_type, hashlib.sha256(body).hexdigest())
    for part in parts:
        if not part.isascii() or (part and not part.isprintable()):
            raise BadProofError(f"{part[:80]!r} has a character that no signed request has")
    return "\n".join(parts).encode("ascii")


def proof_of(token: str, challenge: str, stated: bytes) -> str:
    """The value of the header for a statement made with this challenge."""
    return f"{challenge} {_text(_signing_key(token).sign(stated))}"


def parse_proof(header: str) -> tuple[str, bytes]:
    """Challenge and signature. Raises `BadProofError`."""
    found = _PROOF_FORM.fullmatch(header)
    if found is None:
        raise BadProofError(f"{HEADER} is not `CHALLENGE SIGNATURE`")
    return found[1], base64.urlsafe_b64decode(found[2] + "==")


def is_signed(verifying: bytes, stated: bytes, signature: bytes) -> bool:
    """Whether the holder of the token with this public key signed the statement."""
    try:
        Ed25519PublicKey.from_public_bytes(verifying).verify(signature, stated)
    except InvalidSignature:
        return False
    return True


def _signing_key(token: str) -> Ed25519PrivateKey:
    return Ed25519PrivateKey.from_private_bytes(hmac.digest(token.encode("ascii"), _SIGNING, hashlib.sha256))


def _text(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).decode("ascii").rstrip("=")
