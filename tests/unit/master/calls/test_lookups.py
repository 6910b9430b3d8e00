"""A look-up of a service while the service gets another provider: whatever overtakes what, a provider is told."""

import asyncio
import ipaddress
import itertools
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.master.caller import Caller
from appliance.master.calls.lookups import LookupCalls
from appliance.master.graph.entries import stand_in
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.ros.uris import parse_node_uri

HOST = ipaddress.ip_address("10.0.0.5")
SERVICE = "/serve"
ORDERS = [
    order
    for order in itertools.permutations("TRAL")
    if order.index("T") < order.index("R") and order.index("A") < order.index("L")
]

pytestmark = pytest.mark.anyio


class Race:
    """ROSMaster and registry while `/server` is started anew and offers its service again.

    Steps: (T) ROSMaster takes the registration, (R) control has its answer; (A) ROSMaster answers the look-up,
    (L) control has that answer.
    """

    def __init__(self) -> None:
        self.registry = Registry()
        self.old, self.new = (self._incarnation(key, port) for key, port in (("old", 4000), ("new", 4001)))
        self.registry.register(self.old, Kind.SERVICE, SERVICE, "5000")
        self.provider = self.old
        self.gates = {step: asyncio.Event() for step in "AL"}
        self.asked = 0
        self.granted: list[Incarnation] = []

    def _incarnation(self, key: str, port: int) -> Incarnation:
        uri = f"http://10.0.0.5:{port}/"
        one = Incarnation(key, "/server", HOST, parse_node_uri(uri), uri, "10.0.0.1", port, port + 100)
        self.registry.add(one)
        return one

    async def call(self, _method: str, _caller_id: str, _service: str) -> list[Any]:
        """As ROSMaster; only the first answer is late."""
        self.asked += 1
        first = self.asked == 1
        if first:
            await self.gates["A"].wait()
        answer = [1, "", stand_in(self.provider)]
        if first:
            await self.gates["L"].wait()
        return answer

    def step(self, name: str) -> None:
        """Let one of the four happen."""
        if name == "T":
            self.provider = self.new
        elif name == "R":
            self.registry.replace(self.old, 0.0)
            self.registry.register(self.new, Kind.SERVICE, SERVICE, "5001")
        else:
            self.gates[name].set()

    def service_granted(self, incarnation: Incarnation, *_given: object) -> None:
        """As `Graph`."""
        self.granted.append(incarnation)

    def calls(self) -> LookupCalls:
        """The look-ups of this site."""
        parts: dict[str, Any] = {
            "rosmaster": self,
            "registry": self.registry,
            "faces": None,
            "mediation": SimpleNamespace(carries_service=lambda _name: True),
            "graph": self,
            "enactor": SimpleNamespace(carry_out=lambda _effects: None),
            "relay": SimpleNamespace(port=lambda one, _kind, _name: one.relay_port),
            "addresses": SimpleNamespace(told_to=lambda _peer: "10.0.0.1"),
        }
        return LookupCalls(**parts, port=11311, stop=lambda _reason: None)


@pytest.mark.parametrize("order", ORDERS, ids="".join)
async def test_a_provider_is_told_whatever_overtakes_what(order: tuple[str, ...]) -> None:
    """The one that is registered when the answer is given: never that there is none."""
    race = Race()
    caller = cast(Caller, SimpleNamespace(caller_id="/client", peer=SimpleNamespace(host=HOST)))
    looking = asyncio.ensure_future(race.calls().lookup_service(caller, SERVICE))
    for name in order:
        race.step(name)
        for _ in range(5):
            await asyncio.sleep(0)
    answer = await asyncio.wait_for(looking, 5)
    old = order.index("A") < order.index("T") and order.index("L") < order.index("R")
    provider = race.old if old else race.new
    uri = f"rosrpc://10.0.0.1:{provider.relay_port}"
    assert answer == [1, f"rosrpc URI: [{uri}]", uri]
    assert race.granted == [provider]


async def test_a_provider_that_the_registry_never_has_is_none() -> None:
    """What ROSMaster alone says is a claim; it is not asked for ever."""
    race = Race()
    race.step("T")
    race.step("A")
    race.step("L")
    caller = cast(Caller, SimpleNamespace(caller_id="/client", peer=SimpleNamespace(host=HOST)))
    assert await race.calls().lookup_service(caller, SERVICE) == [-1, "no provider", ""]
    assert (race.granted, race.asked) == ([], 6)
