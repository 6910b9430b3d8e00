"""Make and verify the access tokens of REST. No I/O.

A token is `rosrv_<id>_<secret>`; the secret has 256 random bits. Only its salted scrypt hash and the data to verify
its keys are stored.
"""

import hashlib
import hmac
import re
import secrets
from typing import NamedTuple

from appliance.base.actors import DISK, OPERATOR
from appliance.signing.bearer_secrets import SecretForm
from appliance.signing.request_signing import TokenKeys, keys_of

_FORM = SecretForm("rosrv_")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,62}")
# `who` has these values in revisions and records that no token made.
_RESERVED = frozenset({DISK, OPERATOR})
# 2**14 * 8 * 128 bytes = 16 MiB and some 40 ms for one check.
_COST, _BLOCK, _PARALLEL, _LENGTH = 1 << 14, 8, 1, 32


class BadTokenNameError(ValueError):
    """The name is not valid for a token."""


class TokenRow(NamedTuple):
    """A stored token. Times are seconds since the epoch; its end is in `EndTable`; `expires` is for people."""

    id: str
    name: str
    role: str
    salt: bytes
    hash: bytes
    created: float
    expires: float
    revoked: float | None
    keys: TokenKeys | None = None  # None: made by a version that derived no keys


def make_token(name: str, role: str, *, now: float, seconds: float) -> tuple[TokenRow, str]:
    """Return the row and the text, which is stored nowhere. Raises `BadTokenNameError`."""
    if not _NAME.fullmatch(name) or name in _RESERVED:
        raise BadTokenNameError(
            f"{name[:80]!r} is not a valid token name: letters, digits and . _ @ -, beginning with a letter or digit, "
            f"at most 63, and not {' or '.join(sorted(_RESERVED))}"
        )
    (token_id, secret, text), salt = _FORM.make(), secrets.token_bytes(16)
    kept = hash_secret(secret, salt)
    return TokenRow(token_id, name, role, salt, kept, now, now + seconds, None, keys_of(text)), text


def parse_token(text: str) -> tuple[str, str] | None:
    """Return the id and the secret, or None for another text."""
    return _FORM.parse(text)


def hash_secret(secret: str, salt: bytes) -> bytes:
    return hashlib.scrypt(
        secret.encode("ascii"), salt=salt, n=_COST, r=_BLOCK, p=_PARALLEL, dklen=_LENGTH, maxmem=64 << 20
    )


def is_secret(secret: str, salt: bytes, kept: bytes) -> bool:
    return hmac.compare_digest(hash_secret(secret, salt), kept)
