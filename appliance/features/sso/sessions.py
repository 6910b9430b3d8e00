"""Keep the sessions of people in memory.

1. Sessions are never stored. A restart with changed roles, and a takeover, end all of them.
2. A name in the audit log means one person at a time: while a person is signed in, another `sub` with this name
   is refused. A sign-on with changed rights ends the person's earlier sessions.
"""

from collections.abc import Callable
from typing import NamedTuple

from appliance.base import clock
from appliance.control.errors import TokenRefusedError, UnknownThingError
from appliance.control.operators.sessions import Session
from appliance.features.sso.identity import name_of
from appliance.features.sso.link import SessionKeys, SignedInPerson
from appliance.features.sso.quotas import SESSIONS
from appliance.signing.request_signing import TokenKeys
from appliance.store.access_tokens import TokenRow
from appliance.store.ends import EndKind, EndTable

ONLINE = EndKind("session", stored=False)
_PREFIX = "sso:"  # no token has such a name
_MOST, _MOST_OF_PERSON = SESSIONS.bounds.whole, SESSIONS.bounds.host


class _Kept(NamedTuple):
    session: Session
    row: TokenRow


class SessionTable:
    """All sessions, oldest first. `changed()` is called when some have reached their end."""

    def __init__(self, ends: EndTable, changed: Callable[[], None]) -> None:
        self._ends = ends
        self._changed = changed
        ends.when_due(ONLINE, self._due)
        self._kept: dict[str, _Kept] = {}

    def rows(self) -> list[TokenRow]:
        return [kept.row for kept in self._usable()]

    def sessions(self) -> list[Session]:
        return [kept.session for kept in self._usable()]

    def of(self, session_id: str) -> Session | None:
        return next((one for one in self.sessions() if one.id == session_id), None)

    def open(self, identity: SignedInPerson, keys: SessionKeys) -> tuple[Session, list[Session]]:
        name, now = f"{_PREFIX}{identity.name}", clock.wall()
        present = self.sessions()
        if any(one.id == keys.id for one in present):
            raise TokenRefusedError("the browser chose the id of another session: sign in again")
        if any(one.name == name and one.subject != identity.subject for one in present):
            raise TokenRefusedError(
                f"another person is signed in as {name}: choose a claim for sso.name_claim that identifies people"
            )
        rights = identity.role, identity.doors
        own = [one for one in present if one.subject == identity.subject]
        ended = [one for one in own if (one.role, one.groups) != rights]
        staying = [one for one in own if one not in ended]
        ended += staying[: max(0, len(staying) + 1 - _MOST_OF_PERSON)]
        if len(present) - len(ended) >= _MOST:
            raise TokenRefusedError(f"{_MOST} people's sessions are open: end some (rosrv sso end NAME)")
        self._drop(*(one.id for one in ended))
        session = Session(
            keys.id, name, identity.subject, identity.mail, identity.role, identity.doors, identity.ends
        )
        # No hash: a session has only keys, and its token is never sent.
        row = TokenRow(
            keys.id,
            name,
            identity.role,
            b"",
            b"",
            now,
            identity.ends,
            None,
            TokenKeys(keys.reading, keys.verifying),
        )
        self._ends.set(ONLINE, keys.id, identity.ends - now)
        self._kept[keys.id] = _Kept(session, row)
        return session, ended

    def end(self, session_id: str, who: str) -> Session:
        found = self.of(session_id)
        if found is None or found.name != who:
            raise UnknownThingError("this is not a session of yours")
        self._drop(session_id)
        return found

    def end_all(self, name: str) -> list[Session]:
        spellings = {name, *(f"{_PREFIX}{one}" for one in (name, name_of(name)))}
        ended = [one for one in self.sessions() if one.name in spellings]
        if not ended:
            names = ", ".join(sorted({one.name for one in self.sessions()})[:20])
            known = f"no person is signed in as {name[:140]!r}; signed in: {names}" if names else ""
            raise UnknownThingError(known or "no person is signed in")
        self._drop(*(one.id for one in ended))
        return ended

    def _usable(self) -> list[_Kept]:
        return [kept for name, kept in self._kept.items() if not self._ends.passed(ONLINE, name)]

    def _due(self, ended: list[str]) -> None:
        self._drop(*ended)
        self._changed()

    def _drop(self, *sessions: str) -> None:
        for session in sessions:
            self._kept.pop(session, None)
        self._ends.forget(ONLINE, *sessions)
