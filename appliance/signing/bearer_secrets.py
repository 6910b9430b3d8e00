"""Make and recognise the secrets that clients show: access tokens, enrolment tokens, tickets, invitations. No I/O.

1. A secret has 256 random bits. It cannot be guessed, so a fast hash is enough, and only the hash is stored.
2. An id of 48 bits names a text in records and finds its stored row. The secrets are compared in constant time.
3. The forms and the hash are stored formats: what earlier versions made is still recognised.
"""

import hashlib
import hmac
import re
import secrets
from collections.abc import Mapping
from typing import Protocol, TypeVar


class _Hashed(Protocol):
    @property
    def hash(self) -> bytes: ...


R = TypeVar("R", bound=_Hashed)


class SecretForm:
    """The texts PREFIX ID SEPARATOR SECRET of one kind."""

    def __init__(self, prefix: str, separator: str = "_") -> None:
        self._text = f"{prefix}{{}}{separator}{{}}"
        self._pattern = re.compile(
            re.escape(prefix) + "([0-9a-f]{12})" + re.escape(separator) + "([A-Za-z0-9_-]{43})"
        )

    def make(self) -> tuple[str, str, str]:
        """Return a new id, its secret, and the text of both."""
        number, secret = secrets.token_hex(6), new_secret()
        return number, secret, self._text.format(number, secret)

    def parse(self, text: str) -> tuple[str, str] | None:
        """Return the id and the secret, or None for a text of another form."""
        match = self._pattern.fullmatch(text)
        return None if match is None else (match[1], match[2])

    def find(self, text: str, rows: Mapping[str, R]) -> R | None:
        """Return the row whose secret the text has, or None. The keys of `rows` are ids."""
        shown = self.parse(text)
        row = None if shown is None else rows.get(shown[0])
        return row if shown is not None and row is not None and is_hash_of(shown[1], row.hash) else None


def new_secret() -> str:
    return secrets.token_urlsafe(32)


def hash_of(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "replace")).digest()


def is_hash_of(secret: str, stored: bytes) -> bool:
    return hmac.compare_digest(hash_of(secret), stored)
