"""Build the part of control for single sign-on."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from appliance.base import clock
from appliance.base.withdrawal import take_effect
from appliance.channel import messages
from appliance.channel.answers.token_answers import SignedOn
from appliance.channel.channel import ChannelClosedError, ChannelFullError
from appliance.channel.link import Link
from appliance.control.core import ControlPart, Core
from appliance.control.errors import TokenRefusedError, UnavailableError, UnknownThingError
from appliance.control.operators.request_method import RequestMethod
from appliance.features.sso import requests
from appliance.features.sso.feature import ROLE
from appliance.features.sso.identity import name_of
from appliance.features.sso.link import (
    SessionKeys,
    SignedInPerson,
    SignOnBegun,
    SignOnConfirmed,
    SignOnFailed,
    SignOnReturned,
    SignOnWanted,
    SsoLink,
)
from appliance.features.sso.quotas import SESSIONS
from appliance.features.sso.settings import Sso
from appliance.signing.request_signing import TokenKeys
from appliance.store.access_tokens import TokenRow
from appliance.store.ends import EndKind, EndTable
from appliance.telemetry.audit_trail import AuditTrail

# Answer the requests of single sign-on in control: begin and complete sign-ons, list and end sessions.

# Keep the sessions of people in memory.
#
# 1. Sessions are never stored. A restart with changed roles, and a takeover, end all of them.
# 2. A name in the audit log means one person at a time: while a person is signed in, another `sub` with this name
#    is refused. A sign-on with changed rights ends the person's earlier sessions.

ONLINE = EndKind("session", stored=False)
_PREFIX = "sso:"  # no token has such a name
_MAX, _MAX_OF_PERSON = SESSIONS.bounds.whole, SESSIONS.bounds.host


class _Kept(NamedTuple):
    session: SignedOn
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

    def sessions(self) -> list[SignedOn]:
        return [kept.session for kept in self._usable()]

    def of(self, session_id: str) -> SignedOn | None:
        return next((session for session in self.sessions() if session.id == session_id), None)

    def open(self, identity: SignedInPerson, keys: SessionKeys) -> tuple[SignedOn, list[SignedOn]]:
        name, now = f"{_PREFIX}{identity.name}", clock.wall()
        present = self.sessions()
        if any(one.id == keys.id for one in present):
            raise TokenRefusedError("the browser chose the id of another session: sign in again")
        if any(one.name == name and one.subject != identity.subject for one in present):
            raise TokenRefusedError(
                f"another person is signed in as {name}: choose a claim for sso.name_claim that identifies people"
            )
        rights = identity.role, list(identity.doors)
        own = [one for one in present if one.subject == identity.subject]
        ended = [one for one in own if (one.role, one.groups) != rights]
        staying = [one for one in own if one not in ended]
        ended += staying[: max(0, len(staying) + 1 - _MAX_OF_PERSON)]
        if len(present) - len(ended) >= _MAX:
            raise TokenRefusedError(f"{_MAX} people's sessions are open: end some (rosrv sso end NAME)")
        self._drop(*(one.id for one in ended))
        session = SignedOn(keys.id, name, identity.subject, identity.mail, *rights, identity.ends)
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

    def end(self, session_id: str, who: str) -> SignedOn:
        found = self.of(session_id)
        if found is None or found.name != who:
            raise UnknownThingError("this is not a session of yours")
        self._drop(session_id)
        return found

    def end_all(self, name: str) -> list[SignedOn]:
        spellings = {name, *(f"{_PREFIX}{one}" for one in (name, name_of(name)))}
        ended = [session for session in self.sessions() if session.name in spellings]
        if not ended:
            names = ", ".join(sorted({session.name for session in self.sessions()})[:20])
            known = f"no person is signed in as {name[:140]!r}; signed in: {names}" if names else ""
            raise UnknownThingError(known or "no person is signed in")
        self._drop(*(one.id for one in ended))
        return ended

    def _usable(self) -> list[_Kept]:
        return [kept for name, kept in self._kept.items() if not self._ends.is_over(ONLINE, name)]

    def _due(self, ended: list[str]) -> None:
        self._drop(*ended)
        self._changed()

    def _drop(self, *sessions: str) -> None:
        for session in sessions:
            self._kept.pop(session, None)
        self._ends.forget(ONLINE, *sessions)


M = TypeVar("M", bound=messages.Message)
_TEXT = 500


class SsoOrders:
    """Answers operators and browsers. `changed()` is called when the usable sessions have changed."""

    def __init__(
        self, trail: AuditTrail, ends: EndTable, changed: Callable[[], None], *, configured: bool
    ) -> None:
        self.link = Link(self._on_message)
        self.sessions = SessionTable(ends, changed)
        self._trail = trail
        self._changed = changed
        self._configured = configured

    async def begin(self, request: requests.SignOnBegin) -> requests.SignOnPlace:
        begun = await self._ask(
            lambda number: SignOnWanted(number, request.keys, request.peer, request.again), SignOnBegun
        )
        return requests.SignOnPlace(begun.url, begun.state)

    async def complete(self, request: requests.SignOnComplete) -> SignedOn:
        try:
            found = await self._ask(
                lambda number: SignOnReturned(number, request.state, request.code, request.issuer),
                SignOnConfirmed,
            )
            if self._trail.obstacle is not None:
                raise UnavailableError(self._trail.obstacle)
            take_effect()
            session, ended = self.sessions.open(found.identity, found.keys)
        except (TokenRefusedError, UnavailableError) as error:
            self._trail.happened(
                "sign-on refused", str(error)[:_TEXT], decision="deny", host=request.peer, category="rest"
            )
            raise
        for one in ended:
            self._ended(one, session.name, "ended by the next sign-on of the person")
        self._trail.happened(
            "signed on",
            f"{session.name} ({session.role}) signed in at the provider",
            host=request.peer,
            category="rest",
            who=session.name,
            subject=session.subject,
            mail=session.mail,
            role=session.role,
            groups=session.groups,
            id=session.id,
            expires=session.expires,
            began_at=found.address,
        )
        self._changed()
        return session

    async def list_sessions(self, _request: requests.SessionsWanted) -> requests.SignedOnList:
        return requests.SignedOnList(self.sessions.sessions())

    async def sign_out(self, request: requests.SignOut, who: str) -> SignedOn:
        session = self.sessions.end(request.session, who)
        self._ended(session, who, "signed out")
        self._changed()
        return session

    async def end(self, request: requests.SessionsEnd, who: str) -> requests.SignedOnList:
        ended = self.sessions.end_all(request.name)
        for one in ended:
            self._ended(one, who, f"was signed out by {who}")
        self._changed()
        return requests.SignedOnList(ended)

    def _ended(self, session: SignedOn, who: str, how: str) -> None:
        self._trail.happened(
            "signed off",
            f"{session.name} {how}",
            category="rest",
            who=who,
            name=session.name,
            subject=session.subject,
            role=session.role,
            groups=session.groups,
            id=session.id,
        )

    async def _ask(self, question: Callable[[int], messages.Message], wanted: type[M]) -> M:
        if not self._configured:
            raise UnknownThingError(
                "this appliance has no provider: name one in sso.issuer of appliance.yaml"
            )
        try:
            answer = await self.link.ask(question, requests.EXCHANGE_SECONDS)
        except (TimeoutError, ChannelFullError, ChannelClosedError):
            raise UnavailableError(
                "the process of single sign-on does not answer: try again, or sign in with a token"
            ) from None
        if isinstance(answer, SignOnFailed):
            if answer.refused:
                raise TokenRefusedError(answer.reason)
            raise UnavailableError(f"{answer.reason}; tokens remain valid")
        if not isinstance(answer, wanted):
            raise UnavailableError("the process of single sign-on gave another answer: try again")
        return answer

    def _on_message(self, message: object) -> None:
        if isinstance(message, SignOnBegun | SignOnConfirmed | SignOnFailed):
            self.link.answered(message.number, message)
        else:
            self.link.close()


_LONGEST = 1 << 16


async def begin(core: Core) -> ControlPart:
    configured = core.settings.of(Sso).issuer is not None
    orders = SsoOrders(core.trail, core.ends, core.bearers.changed, configured=configured)
    core.links.attach(ROLE, orders.link, SsoLink, longest=_LONGEST)
    if configured:
        core.bearers.provide(orders.sessions)
    return ControlPart(
        (
            RequestMethod(requests.SignOnBegin, orders.begin, order=False),
            RequestMethod(requests.SignOnComplete, orders.complete),
            RequestMethod(requests.SessionsWanted, orders.list_sessions, order=False),
            RequestMethod(requests.SignOut, orders.sign_out, who=True, full_disk=True),
            RequestMethod(requests.SessionsEnd, orders.end, who=True, full_disk=True),
        )
    )
