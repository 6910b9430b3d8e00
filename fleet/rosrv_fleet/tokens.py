"""Keep the tokens of operators: only their SHA-256, because a token is random and as long as a key."""

import enum
import hashlib
import re
import secrets
import time
from pathlib import Path

import msgspec

from appliance.base.atomic_files import write_whole

_NAME = re.compile("[a-z0-9][a-z0-9._-]{0,62}")


class FleetRole(enum.StrEnum):
    """The roles of operators, ascending: a role may do what those before it may do."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"


class OperatorToken(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A token: the holder's name, the role, the hash, and the time of creation in nanoseconds since the epoch."""

    name: str
    role: FleetRole
    hash: str
    added: int

    def may(self, role: FleetRole) -> bool:
        """Whether the holder may do what `role` may do."""
        order = list(FleetRole)
        return order.index(self.role) >= order.index(role)


class TokenError(Exception):
    """A token cannot be made or removed; the message has the reason."""


class Tokens:
    """The tokens in a file; changes by another process are noticed at once."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def all(self) -> list[OperatorToken]:
        """Return the tokens. Raises `OSError` and `msgspec.MsgspecError`."""
        try:
            return msgspec.json.decode(self._file.read_bytes(), type=list[OperatorToken])
        except FileNotFoundError:
            return []

    def holder(self, token: str) -> OperatorToken | None:
        """Return the token with this text, or None."""
        digest = hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()
        return next((one for one in self.all() if secrets.compare_digest(one.hash, digest)), None)

    def add(self, name: str, role: FleetRole) -> str:
        """Make a token and return its text, which is stored nowhere. Raises `TokenError` and `OSError`."""
        tokens = self.all()
        if _NAME.fullmatch(name) is None:
            raise TokenError(
                f"{name!a}: use 1 to 63 small letters, digits, '.', '_', '-'; first a letter or digit"
            )
        if any(one.name == name for one in tokens):
            raise TokenError(f"{name} already has a token; remove it first: rosrv-fleet token remove {name}")
        text = secrets.token_urlsafe(32)
        digest = hashlib.sha256(text.encode()).hexdigest()
        self._write([*tokens, OperatorToken(name=name, role=role, hash=digest, added=time.time_ns())])
        return text

    def remove(self, name: str) -> None:
        """Remove a token. Raises `TokenError` and `OSError`."""
        tokens = self.all()
        left = [one for one in tokens if one.name != name]
        if len(left) == len(tokens):
            raise TokenError(f"{name!a} has no token; list them: rosrv-fleet token list")
        self._write(left)

    def _write(self, tokens: list[OperatorToken]) -> None:
        write_whole(self._file, msgspec.json.encode(tokens), 0o600)
