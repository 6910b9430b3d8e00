"""Keep the invitations with which robots enrol themselves.

1. Only the output of `add` contains the token. Its hash is the file name.
2. A token is valid for one request. Its hash is stored before the robot is enrolled, so the robot may repeat the
   request, even after a crash, and any other request with this token is rejected.
3. Every other change of a robot's certificate withdraws its invitations, so a repeated request cannot undo it.
"""

import hashlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.signing.bearer_secrets import hash_of, new_secret
from rosrv_fleet.enrolment import EnrolmentError
from rosrv_fleet.robots import changing, record_act

_TOKEN = re.compile("rosrv-join_[A-Za-z0-9_-]{43}")


class InvalidInvitationError(Exception):
    """A token is not valid. The message does not reveal the reason."""

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
    """The invitations in a folder, one file each. A running collector accepts new ones immediately."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def add(self, name: str, group: str, seconds: float, appliance: str = "") -> tuple[PendingRobot, str]:
        """Make an invitation, which replaces earlier ones of the same appliance, and return it with its token."""
        pending = PendingRobot(name=name, group=group, expires=clock.wall() + seconds, appliance=appliance)
        token = f"rosrv-join_{new_secret()}"
        with changing(self._folder), record_act(self._folder.parent, "robot invite", name, group):
            self._remove(name, appliance)
            self._keep(token, pending)
        return pending, token

    def withdraw(self, name: str) -> None:
        """Remove all invitations of a robot, including used ones."""
        with changing(self._folder):
            kept = map(_read, self._folder.glob("*.json"))
            if any(pending is not None and pending.name == name for pending in kept):
                with record_act(self._folder.parent, "invitation withdraw", name):
                    self._remove(name)

    def _remove(self, name: str, appliance: str | None = None) -> None:
        for file in self._folder.glob("*.json"):
            pending = _read(file)
            its = pending is not None and pending.name == name and appliance in (None, pending.appliance)
            if its or (file.is_file() if pending is None else pending.expires <= clock.wall()):
                file.unlink()

    @contextmanager
    def using(self, token: str, request: bytes) -> Iterator[PendingRobot]:
        """Mark the token as used by this request, and yield the robot that it invites.

        `request` of the yielded robot is set only if it sent the same request before. If the block raises
        `EnrolmentError`, the token can be used again. Raise `InvalidInvitationError` if the token is not valid.
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
        return self._folder / f"{hash_of(token).hex()}.json"


def _read(file: Path) -> PendingRobot | None:
    try:
        return msgspec.json.decode(file.read_bytes(), type=PendingRobot)
    except (OSError, ValueError):
        return None
