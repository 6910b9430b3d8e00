from collections.abc import Iterator, Sequence

import pytest

from appliance.base import clock
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.master.reconcile import reminders
from appliance.master.reconcile.reminders import Reminders
from tests.support.incarnations import incarnation
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio
Reminded = list[tuple[str, str, list[str]]]


def reminding(absences: int) -> tuple[Reminders, Reminded]:
    """Return reminders of /ear, which has no connection to /mouth in the first `absences` looks."""
    registry, reminded, looks = Registry(), Reminded(), iter(range(absences))
    for number, name in enumerate(("/ear", "/other", "/mouth")):
        node = incarnation(name, 4000 + number)
        registry.add(node)
        kind = Kind.PUBLICATION if name == "/mouth" else Kind.SUBSCRIPTION
        registry.register(node, kind, "/chatter", "std_msgs/String")

    def absent(nodes: Sequence[Incarnation]) -> Iterator[tuple[Incarnation, str, list[Incarnation]]]:
        if next(looks, None) is not None:
            ear, _other, mouth = nodes
            yield ear, "/chatter", [mouth]

    def renew(subscriber: Incarnation, topic: str, publishers: Sequence[Incarnation]) -> None:
        reminded.append((subscriber.name, topic, [publisher.key for publisher in publishers]))

    return Reminders(registry, absent, renew), reminded


@pytest.mark.parametrize(("absences", "gentle", "renewed"), [(0, 0, 0), (1, 1, 0), (99, 1, 7)])
async def test_reminded_until_back(
    monkeypatch: pytest.MonkeyPatch, absences: int, gentle: int, renewed: int
) -> None:
    monkeypatch.setattr(reminders, "_PAUSES", (0.0,) * 8)
    looks, reminded = reminding(absences)
    looks.begin()
    assert looks.round is not None
    await looks.round
    first, anew = ("/ear", "/chatter", list[str]()), ("/ear", "/chatter", ["key of /mouth"])
    assert reminded == [first] * gentle + [anew] * renewed


async def test_a_lasting_absence_ends_with_a_reminder() -> None:
    looks, reminded = reminding(10_000)
    times, machine = list[float](), VirtualClock()
    with clock.using(machine):
        for second in range(0, 3000, 5):
            before = len(reminded)
            looks.remind_lasting()
            times += [second] * (len(reminded) - before)
            machine.advance(5.0)
    assert times == [5, 15, 35, 75, 155, 315, 635, 1235, 1835, 2435]
    assert reminded[0] == ("/ear", "/chatter", ["key of /mouth"])
