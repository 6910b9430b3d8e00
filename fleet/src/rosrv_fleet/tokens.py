"""Keep the hashes of operators' tokens."""

import enum
import re
import secrets
from pathlib import Path

import msgspec

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.signing.bearer_secrets import hash_of, new_secret
from rosrv_fleet.robots import changing, record_act
from rosrv_fleet.segment_store import read_stored

_NAME = re.compile("[a-z0-9][a-z0-9._-]{0,62}")


class FleetRole(enum.StrEnum):
    """The roles of operators. Each includes the rights of those before it."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"


class OperatorToken(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An operator's token, made at `added` (nanoseconds since the epoch)."""

    name: str
    role: FleetRole
    hash: str
    added: int

    def may(self, role: FleetRole) -> bool:
        order = list(FleetRole)
        return order.index(self.role) >= order.index(role)


class TokenError(Exception):
    """A token cannot be made or removed."""


class OperatorTokens:
    """The tokens in a file. Changes by another process are noticed immediately. The methods raise `OSError`."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def all(self) -> list[OperatorToken]:
        try:
            return read_stored(self._file, list[OperatorToken])
        except FileNotFoundError:
            return []

    def holder(self, token: str) -> OperatorToken | None:
        digest = hash_of(token).hex()
        return next((one for one in self.all() if secrets.compare_digest(one.hash, digest)), None)

    def add(self, name: str, role: FleetRole) -> str:
        if _NAME.fullmatch(name) is None:
            raise TokenError(
                f"{name!a}: use 1 to 63 of a-z, 0-9, '.', '_' and '-'; begin with a letter or digit"
            )
        text = new_secret()
        made = OperatorToken(name=name, role=role, hash=hash_of(text).hex(), added=clock.wall_ns())
        with changing(self._file.parent):
            tokens = self.all()
            if any(token.name == name for token in tokens):
                raise TokenError(
                    f"{name} already has a token; remove it first: rosrv-fleet token remove {name}"
                )
            with record_act(self._file.parent, "token add", name, role):
                self._write([*tokens, made])
        return text

    def remove(self, name: str) -> None:
        with changing(self._file.parent):
            tokens = self.all()
            left = [token for token in tokens if token.name != name]
            if len(left) == len(tokens):
                raise TokenError(f"{name!a} has no token; list them: rosrv-fleet token list")
            with record_act(self._file.parent, "token remove", name):
                self._write(left)

    def _write(self, tokens: list[OperatorToken]) -> None:
        write_whole(self._file, msgspec.json.encode(tokens), 0o600)
