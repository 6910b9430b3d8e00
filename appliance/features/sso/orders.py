"""Answer the requests of single sign-on in control: begin and complete sign-ons, list and end sessions."""

from collections.abc import Callable
from typing import TypeVar

from appliance.channel import messages
from appliance.channel.channel import ChannelClosedError, ChannelFullError
from appliance.channel.link import Link
from appliance.control.errors import TokenRefusedError, UnavailableError, UnknownThingError
from appliance.control.operators.sessions import Session
from appliance.features.sso import requests
from appliance.features.sso.link import (
    SignOnBegun,
    SignOnConfirmed,
    SignOnFailed,
    SignOnReturned,
    SignOnWanted,
)
from appliance.features.sso.sessions import SessionTable
from appliance.store.ends import EndTable
from appliance.telemetry.audit_trail import AuditTrail

M = TypeVar("M", bound=messages.Message)
_TEXT = 500


class SsoOrders:
    """Answers operators and browsers. `changed()` is called when the usable sessions have changed."""

    def __init__(
        self, trail: AuditTrail, ends: EndTable, changed: Callable[[], None], *, configured: bool
    ) -> None:
        self.link = Link(self._received)
        self.sessions = SessionTable(ends, changed)
        self._trail = trail
        self._changed = changed
        self._configured = configured

    async def begin(self, request: requests.SignOnBegin) -> requests.SignOnPlace:
        begun = await self._ask(
            lambda number: SignOnWanted(number, request.keys, request.peer, request.again), SignOnBegun
        )
        return requests.SignOnPlace(begun.url, begun.state)

    async def complete(self, request: requests.SignOnComplete) -> requests.SignedOn:
        try:
            found = await self._ask(
                lambda number: SignOnReturned(number, request.state, request.code, request.issuer),
                SignOnConfirmed,
            )
            if self._trail.obstacle is not None:
                raise UnavailableError(self._trail.obstacle)
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
            groups=list(session.groups),
            id=session.id,
            expires=session.expires,
            began_at=found.address,
        )
        self._changed()
        return _shown(session)

    async def listed(self, _request: requests.SessionsWanted) -> requests.SignedOnList:
        return requests.SignedOnList([_shown(one) for one in self.sessions.sessions()])

    async def sign_out(self, request: requests.SignOut, who: str) -> requests.SignedOn:
        session = self.sessions.end(request.session, who)
        self._ended(session, who, "signed out")
        self._changed()
        return _shown(session)

    async def end(self, request: requests.SessionsEnd, who: str) -> requests.SignedOnList:
        ended = self.sessions.end_all(request.name)
        for one in ended:
            self._ended(one, who, f"was signed out by {who}")
        self._changed()
        return requests.SignedOnList([_shown(one) for one in ended])

    def _ended(self, session: Session, who: str, how: str) -> None:
        self._trail.happened(
            "signed off",
            f"{session.name} {how}",
            category="rest",
            who=who,
            name=session.name,
            subject=session.subject,
            role=session.role,
            groups=list(session.groups),
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

    def _received(self, message: object) -> None:
        if isinstance(message, SignOnBegun | SignOnConfirmed | SignOnFailed):
            self.link.answered(message.number, message)
        else:
            self.link.close()


def _shown(session: Session) -> requests.SignedOn:
    return requests.SignedOn(
        session.id,
        session.name,
        session.subject,
        session.mail,
        session.role,
        list(session.groups),
        session.expires,
    )
