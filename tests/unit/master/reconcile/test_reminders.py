import ipaddress
from typing import Any, cast

import pytest

from appliance.base import clock
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.master.reconcile import reminders
from appliance.master.reconcile.reminders import Reminders
from roswire.uris import parse_node_uri
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio
HOST = ipaddress.ip_address("10.0.0.5")


class Told:
    def __init__(self, absent_for: int) -> None:
        self.absent_for = absent_for
        self.reminded: list[tuple[str, str, list[str]]] = []

    def absent(self, subscribers: list[Incarnation]) -> list[tuple[Incarnation, str, list[Incarnation]]]:
        self.absent_for -= 1
        ear, _other, mouth = subscribers
        return [(ear, "/chatter", [mouth])] if self.absent_for >= 0 else []

    def renew(self, subscriber: Incarnation, topic: str, absent: list[Incarnation]) -> None:
        self.reminded.append((subscriber.name, topic, [one.key for one in absent]))


def node(registry: Registry, name: str, kind: Kind) -> Incarnation:
    uri = "http://10.0.0.5:4000/"
    node = Incarnation(f"key of {name}", name, HOST, parse_node_uri(uri), uri, "10.0.0.1", 19001, 19002)
    registry.add(node)
    registry.register(node, kind, "/chatter", "std_msgs/String")
    return node


@pytest.mark.parametrize(("absent_for", "reminded", "renewed"), [(0, 0, 0), (1, 1, 0), (99, 1, 7)])
async def test_reminded_until_back(
    monkeypatch: pytest.MonkeyPatch, absent_for: int, reminded: int, renewed: int
) -> None:
    monkeypatch.setattr(reminders, "_PAUSES", (0.0,) * 8)
    registry = Registry()
    node(registry, "/ear", Kind.SUBSCRIPTION)
    node(registry, "/other", Kind.SUBSCRIPTION)
    node(registry, "/mouth", Kind.PUBLICATION)
    told = Told(absent_for)
    looks = Reminders(registry, cast(Any, told))
    looks.begin()
    assert looks.round is not None
    await looks.round
    gentle, anew = ("/ear", "/chatter", list[str]()), ("/ear", "/chatter", ["key of /mouth"])
    assert told.reminded == [gentle] * reminded + [anew] * renewed


async def test_a_lasting_absence_ends_with_a_reminder() -> None:
    registry = Registry()
    for name, kind in (
        ("/ear", Kind.SUBSCRIPTION),
        ("/other", Kind.SUBSCRIPTION),
        ("/mouth", Kind.PUBLICATION),
    ):
        node(registry, name, kind)
    told, times = Told(10_000), list[float]()
    machine = VirtualClock()
    with clock.using(machine):
        looks = Reminders(registry, cast(Any, told))
        for second in range(0, 3000, 5):
            before = len(told.reminded)
            looks.remind_lasting()
            times += [second] * (len(told.reminded) - before)
            machine.advance(5.0)
    assert times == [5, 15, 35, 75, 155, 315, 635, 1235, 1835, 2435]
    assert told.reminded[0] == ("/ear", "/chatter", ["key of /mouth"])
