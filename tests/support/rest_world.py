"""Run REST in one process: the api's gate, routes and link, and control's link, authentication and dispatch.

All of these are the product's own. Only the parts of control that answer requests are models.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import httpx
from fastapi import FastAPI

from appliance.api.app import build_app
from appliance.api.front.access import TokenAuthenticator
from appliance.api.front.control import ControlLink
from appliance.api.front.history import SampleHistory
from appliance.api.front.journal import Journal
from appliance.api.front.request_gate import RequestGate
from appliance.api.front.services import Services
from appliance.base.clock import using
from appliance.channel import admin
from appliance.channel.admin import AdminRequest, answer_to
from appliance.channel.answers.graph_answers import Registrations
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.monitor_answers import Monitors
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.channel.messages.api import ApiLink, ClientRequest, RequestMade, TokenKept
from appliance.channel.operations import CHANGES, request_named
from appliance.configuration.settings import ApiLimits, Settings
from appliance.control.assembly.policies import Policies
from appliance.control.operators.administration import Administration
from appliance.control.operators.queries import Queries
from appliance.control.operators.request_method import RequestMethod
from appliance.control.operators.request_methods import request_methods
from appliance.control.operators.token_orders import TokenOrders
from appliance.control.rest.rest import RestLink, RestUses
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.access_tokens import TokenRow, make_token
from tests.support.answers import example
from tests.support.asgi import sent
from tests.support.core import FakeTrail
from tests.support.feature_parts import answered_later, idle_parts
from tests.support.idle import idle
from tests.support.inline_loop import InlineLoop
from tests.support.memory_channel import memory_link
from tests.support.virtual_clock import VirtualClock

T = TypeVar("T")
R = TypeVar("R", bound=AdminRequest[Any])
ROLES = ("viewer", "investigator", "operator", "admin")
_NOW = 1_700_000_000.0
_STATE = Settings().state
_KIT = {"name": "laptop", "address": "10.9.0.2", "appliance": "10.9.0.1"}


def _example_for(request: type, **fields: Any) -> Any:
    answer: Any = answer_to(request)
    return example(answer, **fields)


def _of_feature(verb: str, **fields: Any) -> dict[type, Any]:
    request = request_named(verb)
    return {} if request is None else {request: _example_for(request, **fields)}


_ANSWERS: dict[type, Any] = {
    admin.PolicyWanted: example(PolicyKnown, revision=7, text="[Nodes]\n", file="f"),
    admin.RegistrationsWanted: example(Registrations),
    **_of_feature("host endpoint", endpoint="10.0.0.9"),
    **_of_feature("host add", **_KIT),
    **_of_feature("host renew", **_KIT),
    admin.MonitorsWanted: example(Monitors, files={"safeZone": "text"}),
}


class Carried:
    def __init__(self) -> None:
        self.answers = dict(_ANSWERS)
        self.orders: list[tuple[AdminRequest[Any], str | None]] = []
        self.error: Exception | None = None

    async def out(self, request: AdminRequest[Any], who: str | None = None) -> Any:
        if type(request) in CHANGES:
            if self.error is not None:
                raise self.error
            self.orders.append((request, who))
        return self.answers.get(type(request)) or _example_for(type(request))


class Tokens:
    def __init__(self) -> None:
        made = {role: make_token(f"a-{role}", role, now=_NOW, seconds=6000) for role in ROLES}
        self.rows = {row.id: row for row, _text in made.values()}
        self.texts = {role: text for role, (_row, text) in made.items()}

    def usable(self) -> list[TokenKept]:
        return [
            TokenKept(row.id, row.name, row.role, row.salt, row.hash, row.expires)
            for row in self.rows.values()
        ]

    def ended(self) -> list[TokenKept]:
        return []

    def usable_row(self, token_id: str) -> TokenRow | None:
        return self.rows.get(token_id)

    def used(self, token_id: str) -> None: ...


class RestWorld:
    def __init__(self, state: Path = _STATE) -> None:
        with using(VirtualClock(wall=_NOW)):
            self._runner = asyncio.Runner(loop_factory=InlineLoop)
            self._runner.get_loop()  # which keeps this clock
        self.carried, self.tokens, self.trail = Carried(), Tokens(), FakeTrail()
        self.gate, self.control = make_api(state)
        self._ends = memory_link(ApiLink)
        self._runner.run(self._connect())

    async def _connect(self) -> None:
        methods = idle_parts().methods() + request_methods(
            queries=idle(Queries),
            policies=idle(Policies),
            monitors=idle(SpecificationManager),
            tokens=idle(TokenOrders),
        )
        self.administration = Administration(
            [
                *(replace(method, answer=self.carried.out) for method in methods),
                *(
                    RequestMethod(request, self.carried.out, who=request in CHANGES, order=False)
                    for request in answered_later()
                ),
            ],
            in_force=lambda: (7, 3),
            durable=self.trail.durable,
            require_room=lambda: None,
            obstacle=lambda: self.trail.obstacle,
        )
        rest = RestLink(
            self.administration, self.tokens, self.trail,
            served=lambda _pin: None, certified=lambda _sha256: None, require_proof=False, uses=RestUses(),
        )  # fmt: skip
        rest.attach(self._ends[0])
        self.control.attach(self._ends[1])
        await asyncio.sleep(0)
        await asyncio.sleep(0)

    @property
    def made(self) -> list[RequestMade]:
        return [
            one for one in self._ends[0].messages if isinstance(one, RequestMade) and type(one.request) in CHANGES
        ]  # fmt: skip

    def sent(self, kind: type[R]) -> list[R]:
        made = [message.request for message in self._ends[0].messages if isinstance(message, RequestMade)]
        return [one for one in made if isinstance(one, kind)]

    def close(self) -> None:
        self._runner.close()

    def asked(
        self, method: str, target: str, body: Any = None, role: str | None = "admin", tag: str | None = None,
        *, kind: str = "text/plain",
    ) -> httpx.Response:  # fmt: skip
        """Return the response. Without a role, there is no token. Strings and bytes have the content type `kind`."""
        headers = {} if role is None else {"Authorization": f"Bearer {self.tokens.texts[role]}"}
        headers |= {} if tag is None else {"If-Match": tag}
        given: dict[str, Any] = {"json": body}
        if isinstance(body, str | bytes):
            headers["Content-Type"] = kind
            given = {"content": body}
        self._ends[0].messages.clear()
        self.trail.records.clear()
        self.carried.orders.clear()
        return self.play(lambda: sent(self.gate, method, target, headers=headers, **given))

    def bypassing(
        self, request: AdminRequest[Any], role: str, asked: ClientRequest | None = None
    ) -> dict[str, Any]:
        self.trail.records.clear()
        self.carried.orders.clear()

        async def play() -> None:
            self._ends[1].send(RequestMade(10_000, request, self.tokens.texts[role], asked))

        self.play(play)
        [record] = self.trail.rows
        return record

    def play(self, what: Callable[[], Awaitable[T]]) -> T:
        async def playing() -> T:
            result = await what()
            for _turn in range(20):
                await asyncio.sleep(0)
            return result

        return self._runner.run(playing())


def idle_application() -> FastAPI:
    return _application(
        ControlLink(lambda _tokens: None, lambda: None), TokenAuthenticator(10, lambda _token: None), Journal(print)
    )  # fmt: skip


def make_api(state: Path = _STATE) -> tuple[RequestGate, ControlLink]:
    door = TokenAuthenticator(10, lambda _token: None)
    control = ControlLink(door.state, lambda: None)
    journal = Journal(control.tell)
    app, limits = _application(control, door, journal, state), ApiLimits(burst=100_000)
    return RequestGate(app, limits=limits, doorkeeper=door, journal=journal, names=["api"]), control


def _application(
    control: ControlLink, door: TokenAuthenticator, journal: Journal, state: Path = _STATE
) -> FastAPI:
    async def nothing() -> Measures:
        return example(Measures)

    return build_app(
        Services(Settings(state=state), control, door, journal, asyncio.Event(), SampleHistory(nothing))
    )
