import asyncio
from typing import Any, cast

import pytest

from appliance.channel.messages import MonitorCallAnswered, MonitorCallWanted
from appliance.control.monitor_call_gate import MonitorCallGate, own_host
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.policy.model import address_of
from appliance.policy.policy_compiler import compile_policy
from roswire.uris import parse_node_uri

ALLOWED = "[Commands]\nlookupService = 127.0.0.1\n[Clients]\n/arm = 127.0.0.1\n"


class Control:
    strict = False

    def __init__(
        self,
        policy: str,
        *,
        offered: bool = True,
        carries: bool = True,
        full: bool = False,
        host: str = "127.0.0.1",
    ) -> None:
        self.records: list[tuple[str, str, bool]] = []
        self.granted: list[str] = []
        self.carries, self.strict, self._full = carries, full, full
        registry, uri = Registry(), "http://10.0.0.5:4000/"
        node = Incarnation("key", "/node", address_of("10.0.0.5"), parse_node_uri(uri), uri, "10.0.0.1", 1, 2)
        registry.add(node)
        if offered:
            registry.register(node, Kind.SERVICE, "/arm", "4001")
        compiled, own = compile_policy(policy, file="p.ini"), cast(Any, self)
        self.gate = MonitorCallGate(registry, own, lambda: None, lambda: compiled, own, own, "/rosrv", host)

    def decided(self, asker: Any, method: str, _category: str, resource: str, decision: Any) -> str:
        self.records.append((f"{asker.host} {asker.caller_id} {method}", resource, decision.allowed))
        return "18ff"

    async def durable(self) -> str | None:
        return "the disk is full" if self._full else None

    def carries_service(self, _service: str) -> bool:
        return self.carries

    def port(self, *_given: object) -> int:
        return 4711

    def service_granted(self, provider: Incarnation, service: str, host: object, caller_id: str) -> None:
        self.granted.append(f"{provider.key} {host} {caller_id} {service}")

    def answer(self) -> MonitorCallAnswered:
        return asyncio.run(self.gate.answer(MonitorCallWanted(7, "/arm")))


def test_an_allowed_call_is_recorded_and_granted() -> None:
    """The grant is like a client's, so its revocation by another policy cuts the call."""
    control = Control(ALLOWED)
    assert control.answer() == MonitorCallAnswered(7, "127.0.0.1", 4711, "/rosrv", "")
    assert control.records == [("127.0.0.1 /rosrv lookupService", "/arm", True)]
    assert control.granted == ["key 127.0.0.1 /rosrv /arm"]


@pytest.mark.parametrize(
    ("listen", "host"),
    [("0.0.0.0", "127.0.0.1"), ("::", "127.0.0.1"), ("10.0.0.9", "10.0.0.9"), ("::1", "::1")],
)
def test_the_client_is_the_address_that_a_relay_connects_from(listen: str, host: str) -> None:
    """A relay that listens on one address cannot be reached on the loopback."""
    assert own_host(listen) == host
    control = Control(ALLOWED.replace("127.0.0.1", host), host=host)
    assert control.answer() == MonitorCallAnswered(7, host, 4711, "/rosrv", "")
    assert (control.records[0][0], control.granted) == (
        f"{host} /rosrv lookupService",
        [f"key {host} /rosrv /arm"],
    )


@pytest.mark.parametrize(
    ("policy", "options", "reason"),
    [
        ("[Commands]\nlookupService = 127.0.0.1\n[Clients]\n/arm = 10.0.0.9\n", {}, "[18ff]"),
        ("[Commands]\nlookupService = 10.0.0.9\n", {}, "[18ff]"),
        (ALLOWED, {"offered": False}, "no node offers the service"),
        (ALLOWED, {"carries": False}, "the relay does not carry the service"),
        (ALLOWED, {"full": True}, "denied: "),
    ],
)
def test_another_call_is_not_granted(policy: str, options: dict[str, Any], reason: str) -> None:
    control = Control(policy, **options)
    answer = control.answer()
    assert reason in answer.refused
    assert not control.granted
    assert len(control.records) == 1
