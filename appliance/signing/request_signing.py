"""Derive two keys from an access token, and sign orders with one of them. No I/O, no clock.

The *reading key* replaces the token in `Authorization: Bearer`, and permits no changes. The *signing key*
(Ed25519) never leaves the client. It signs each order: the HTTP request as sent, with a challenge from control,
which accepts each challenge once.

1. The appliance stores `TokenKeys`, from which neither key can be derived. Access to the state, a backup or the
   api's traffic is not enough to sign an order.
2. The signed text has seven lines, one for each part of the request. A part cannot contain control characters, so
   no two requests have the same text.
3. Any change of this format needs a new version in the first line, in the derivations and in
   `docs/reference/rest.md`.
"""

import base64
import hashlib
import hmac
import re
from typing import NamedTuple

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from appliance.signing.bearer_secrets import SecretForm, hash_of

HEADER = "ROSRV-Proof"  # "CHALLENGE SIGNATURE"
_VERSION = "rosrv order 1"
_READING, _SIGNING = b"rosrv reading key 1", b"rosrv signing key 1"
_READING_FORM = SecretForm("rosrv-read_")
_PROOF_FORM = re.compile(r"([!-~]{1,200}) ([A-Za-z0-9_-]{86})")


class BadProofError(ValueError):
    """A proof is invalid, or a request cannot be signed."""


class TokenKeys(NamedTuple):
    """SHA-256 of the reading key, and the public signing key, 32 bytes each."""

    reading: bytes
    verifying: bytes


def keys_of(token: str) -> TokenKeys:
    """Derive the stored keys from a token, `rosrv_ID_SECRET`."""
    return TokenKeys(hash_of(reading_key(token)), _signing_key(token).public_key().public_bytes_raw())


def reading_key(token: str) -> str:
    """Return `rosrv-read_ID_KEY`."""
    token_id = token.split("_")[1]
    return f"rosrv-read_{token_id}_{_text(hmac.digest(token.encode('ascii'), _READING, hashlib.sha256))}"


def reading_id(shown: str) -> str | None:
    found = _READING_FORM.parse(shown)
    return None if found is None else found[0]


def statement(
    challenge: str, *, method: str, target: str, if_match: str, content_type: str, body: bytes
) -> bytes:
    """Return the text that signs a request. `target` is the path and query as sent; a missing header is empty.

    Raises `BadProofError` for a part with a control or non-ASCII character.
    """
    parts = (_VERSION, challenge, method, target, if_match, content_type, hashlib.sha256(body).hexdigest())
    for part in parts:
        if not part.isascii() or (part and not part.isprintable()):
            raise BadProofError(f"{part[:80]!r} has a character that a signed request must not have")
    return "\n".join(parts).encode("ascii")


def proof_of(token: str, challenge: str, stated: bytes) -> str:
    return f"{challenge} {_text(_signing_key(token).sign(stated))}"


def parse_proof(header: str) -> tuple[str, bytes]:
    """Return the challenge and the signature. Raises `BadProofError`."""
    match = _PROOF_FORM.fullmatch(header)
    if match is None:
        raise BadProofError(f"{HEADER} is not `CHALLENGE SIGNATURE`")
    return match[1], base64.urlsafe_b64decode(match[2] + "==")


def is_signed(verifying: bytes, stated: bytes, signature: bytes) -> bool:
    try:
        Ed25519PublicKey.from_public_bytes(verifying).verify(signature, stated)
    except InvalidSignature:
        return False
    return True


def _signing_key(token: str) -> Ed25519PrivateKey:
    return Ed25519PrivateKey.from_private_bytes(hmac.digest(token.encode("ascii"), _SIGNING, hashlib.sha256))


def _text(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).decode("ascii").rstrip("=")
