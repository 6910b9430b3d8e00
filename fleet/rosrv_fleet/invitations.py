"""Keep the invitations with which robots enrol themselves.

1. Only the output of `add` has a token; its hash is the name of its file. The secret has 256 random bits, so a
   fast hash is enough.
2. A token is valid for one request of one robot, which is noted in the file before the robot is enrolled.
   Repeating it is harmless, also after a crash; any other request with this token is rejected.
3. Whatever else changes a robot's certificate withdraws its invitations, so no repeated request can undo it.
"""

import hashlib
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from rosrv_fleet.acts import recorded
from rosrv_fleet.enrolment import EnrolmentError
from rosrv_fleet.robots import changing

_TOKEN = re.compile("rosrv-join_[A-Za-z0-9_-]{43}")


class InvalidInvitationError(Exception):
    """A token is not valid; the text does not reveal why."""

    def __init__(self) -> None:
        super().__init__(
            "the invitation is wrong, already used or expired: make another one on the collector"
            " (rosrv-fleet robot invite NAME)"
        )


class PendingRobot(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot that may join until `expires` (seconds since the epoch).

    `request` is the SHA-256 of the request that used the invitation, or empty.
    """

    name: str
    group: str
    expires: float
    request: str = ""
    appliance: str = ""


class Invitations:
    """The invitations in a folder, one file each; a running collector immediately accepts new ones."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def add(self, name: str, group: str, seconds: float, appliance: str = "") -> tuple[PendingRobot, str]:
        """Replace earlier invitations of the appliance; return the token. Raises `OSError`."""
        pending = PendingRobot(name=name, group=group, expires=clock.wall() + seconds, appliance=appliance)
        token = f"rosrv-join_{secrets.token_urlsafe(32)}"
        with changing(self._folder), recorded(self._folder.parent, "robot invite", name, group):
            self._remove(name, appliance)
            self._keep(token, pending)
        return pending, token

    def withdraw(self, name: str) -> None:
        """Remove also used invitations. Raises `OSError`."""
        with changing(self._folder):
            kept = map(_read, self._folder.glob("*.json"))
            if any(pending is not None and pending.name == name for pending in kept):
                with recorded(self._folder.parent, "invitation withdraw", name):
                    self._remove(name)

    def _remove(self, name: str, appliance: str | None = None) -> None:
        for file in self._folder.glob("*.json"):
            pending = _read(file)
            its = pending is not None and pending.name == name and appliance in (None, pending.appliance)
            if its or (file.is_file() if pending is None else pending.expires <= clock.wall()):
                file.unlink()

    @contextmanager
    def using(self, token: str, request: bytes) -> Iterator[PendingRobot]:
        """`request` is set if the request is repeated. If the block raises `EnrolmentError`, another request may
        use the token.

        Raises `InvalidInvitationError` and `OSError`.
        """
        digest = hashlib.sha256(request).hexdigest()
        with changing(self._folder):
            pending = _read(self._file(token)) if _TOKEN.fullmatch(token) else None
            if pending is not None and pending.expires <= clock.wall():
                self._file(token).unlink()  # a clock that is set back later does not make it valid again
                raise InvalidInvitationError
            if pending is None or pending.request not in ("", digest):
                raise InvalidInvitationError
            if pending.request:
                yield pending
                return
            self._keep(token, msgspec.structs.replace(pending, request=digest))
            try:
                yield pending
            except EnrolmentError:
                self._keep(token, pending)
                raise

    def _keep(self, token: str, pending: PendingRobot) -> None:
        write_whole(self._file(token), msgspec.json.encode(pending), 0o600)

    def _file(self, token: str) -> Path:
        return self._folder / f"{hashlib.sha256(token.encode()).hexdigest()}.json"


def _read(file: Path) -> PendingRobot | None:
    try:
        return msgspec.json.decode(file.read_bytes(), type=PendingRobot)
    except (OSError, ValueError):
        return None
