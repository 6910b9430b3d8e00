"""How close conditions came in the relay: as on a recording of the same messages, since the load and of the day."""

from collections.abc import Iterator

import pytest

from appliance.channel.messages import Approach, MarginRow
from appliance.relay.monitors.margin_counts import Margins
from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.tests.on_module import on_module
from roswire.standard import standard_definitions
from tests.unit.relay.monitors.test_interceptor import string
from tests.unit.relay.monitors.test_shadow import Trying

NEAR = """
near() {
    int seen = 0;
    event said(std::string text) /chatter std_msgs/String '{data:text}' {
        seen = seen + 1;
        double far = text.size() * 0.5;
        if (far > 2.2) { return; }
        if (seen - 3 >= far) { text = "late"; }
    }
}
"""
WORDS = ("a", "four", "eleven", "bb", "ccc")
DAY = 86_400 * 10**9


@pytest.fixture
def world() -> Iterator[Trying]:
    """A relay with one node."""
    world = Trying()
    yield world
    world.close()


def offline() -> list[tuple[int, int, bool, float, float]]:
    """What `rosrv monitor replay --margins` finds in these messages."""
    monitors = on_module(compiled_from({"0.rv": NEAR}, standard_definitions(), margins=True))
    monitors.start(0)
    for word in WORDS:
        monitors.judge("/chatter", string(word)[4:], 1)
    return [
        (one.position.line, one.position.column, one.holds, one.left, one.right)
        for one in monitors.take_margins()
    ]


@pytest.mark.parametrize("tried", [(), ("near",)])
def test_live_and_offline_agree_on_the_same_messages(world: Trying, tried: tuple[str, ...]) -> None:
    """In force and on trial, and together with batches or one by one."""
    world.state_trials(NEAR, tried=tried)
    publisher, subscriber = world.typed()
    publisher.send(string(WORDS[0]) + string(WORDS[1]))
    publisher.send(b"".join(map(string, WORDS[2:])))
    kept = WORDS if tried else ("a", "four", "late", "late")
    world.gets(subscriber, b"".join(map(string, kept)))
    world.until(lambda: not world.engine.middle.trials.waiting)
    world.engine.middle.tick()
    rows = world.row("near").margins
    expected = offline()
    assert len(expected) == 4
    assert [(row.line, row.column, row.holds, row.load.left, row.load.right) for row in rows] == expected
    assert [row.today for row in rows] == [row.load for row in rows]
    assert [row.threshold for row in rows] == [1, 1, None, None]


def test_it_is_kept_with_the_monitor_and_begins_anew_with_another_text(world: Trying) -> None:
    """Other specifications that come or go change nothing of it."""
    world.state_trials(NEAR)
    publisher, subscriber = world.typed()
    publisher.send(string("four"))
    world.gets(subscriber, string("four"))
    other = NEAR.replace("near()", "other()").replace("/chatter", "/elsewhere")
    world.state_trials(NEAR, other, revision=2)
    world.engine.middle.tick()
    (first, _second) = world.row("near").margins
    assert (first.load.left, first.load.right) == (2.0, 2.2)
    world.state_trials(NEAR.replace("2.2", "2.3"), revision=3)
    world.engine.middle.tick()
    assert world.row("near").margins == []


def test_a_day_ends_at_midnight() -> None:
    """The nearest of yesterday is not today's; that since the load stays."""
    monitors = MonitorSet.of(compiled_from({"0.rv": NEAR}, standard_definitions(), margins=True))
    monitors.start(0)
    margins = Margins()

    def rows(word: str | None, time: int) -> list[MarginRow]:
        if word is not None:
            monitors.judge("/chatter", string(word)[4:], time)
        margins.take(monitors, time)
        return margins.rows("near", time)

    assert rows("four", 5)[0].today == Approach(2.0, 2.2, 5)
    assert rows("a", 6)[0].today == Approach(2.0, 2.2, 5)
    (first, *_rest) = rows(None, DAY)
    assert (first.today, first.load) == (None, Approach(2.0, 2.2, 5))
    (first, *_rest) = rows("a", DAY + 1)
    assert (first.today, first.load) == (Approach(0.5, 2.2, DAY + 1), Approach(2.0, 2.2, 5))
