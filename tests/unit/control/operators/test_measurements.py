import random

import pytest

from appliance.channel.messages import TopicTraffic
from appliance.control.assembly.monitor_states import published_now
from appliance.control.operators.queries import by_resource, carried_of, from_zero
from appliance.master.endpoints import traffic
from appliance.master.endpoints.traffic import MAX_RESOURCES, OTHERS, RelayTraffic
from appliance.master.graph.registry import Kind, Registry
from appliance.specifications.live_topics import LiveType
from tests.support.core import FakeTrail
from tests.support.incarnations import incarnation
from tests.support.virtual_clock import let_time_pass


def test_sums_by_name() -> None:
    rows = [("/a", (1, 10)), ("/b", (2, 20)), ("/a", (3, 30))]
    assert by_resource(rows) == {"/a": [4, 40], "/b": [2, 20]}


def test_counters_begin_at_zero() -> None:
    """Otherwise Prometheus would not see the first event as an increase."""
    counts = from_zero({("fault", "safe"): 2}, [("fault", "safe"), ("drop", "safe")])
    assert counts == {("fault", "safe"): 2, ("drop", "safe"): 0}


def test_names_are_bounded() -> None:
    sums = by_resource((f"/topic{number}", (1,)) for number in range(MAX_RESOURCES + 500))
    assert len(sums) == MAX_RESOURCES + 1
    assert sums[OTHERS] == [500]
    assert sum(row[0] for row in sums.values()) == MAX_RESOURCES + 500


def test_few_topics_have_their_own_histogram() -> None:
    sums = by_resource(((f"/topic{number}", (1, 0.5)) for number in range(5)), 3)
    assert sums == {"/topic0": [1, 0.5], "/topic1": [1, 0.5], "/topic2": [1, 0.5], OTHERS: [2, 1.0]}


def test_counters_of_a_topic_survive_its_publishers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traffic, "MAX_RESOURCES", 2)
    registry = Registry()
    for number in range(4):
        registry.add(incarnation("/node", 4000 + number, key=f"k{number}"))
    counted = RelayTraffic(FakeTrail(), registry, 1, lambda _node, _topic: None)
    for number in range(4):
        rows = [
            TopicTraffic(f"k{number}", "/a", 10, 100, 1, 1, [1, 2], 0.5),
            TopicTraffic(f"k{number}", f"/own{number}", 1, 1, 0, 1),
        ]
        counted.reported(rows)
        before = carried_of(counted)
        counted.forgotten(f"k{number}")
        after = carried_of(counted)
        assert (after[0]["/a"], after[1]) == (before[0]["/a"], before[1])
    assert (counted.total.messages, counted.total.dropped) == (44, 4)
    assert carried_of(counted) == (
        {"/a": [40, 400, 4], "/own3": [1, 1, 0], OTHERS: [3, 3, 0]},
        {"/a": [4, 8, 2.0]},
    )


@pytest.mark.parametrize("seed", range(8))
def test_a_name_stays_while_its_topic_is_present_and_no_host_takes_all(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Ended topics of one host do not displace the robot's, and no counter decreases."""
    for limit in ("MAX_RESOURCES", "MAX_DELAYED"):
        monkeypatch.setattr(traffic, limit, 8)
    chance, registry = random.Random(seed), Registry()  # noqa: S311  a history by seed
    counted = RelayTraffic(FakeTrail(), registry, 1, lambda _node, _topic: None)
    robot, live, number = incarnation("/base", host="10.0.0.1", key="robot"), list[str](), 0
    registry.add(robot)
    before: dict[str, float] = {}
    for step in range(200):
        if chance.random() < 0.6:
            number += 1
            live.append(f"guest{number}")
            registry.add(incarnation(f"/guest{number}", 5000 + number, host="10.0.0.9", key=live[-1]))
        elif live:
            counted.forgotten(live.pop(chance.randrange(len(live))))
        rows = [TopicTraffic(key, f"/{key}", 1, 1, 0, 1, [1], 0.1) for key in live]
        late = [TopicTraffic("robot", "/late", 1, 1, 0, 1, [1], 0.1)] if step > 50 else []
        counted.reported([*rows, TopicTraffic("robot", "/cmd_vel", 1, 1, 0, 1, [1], 0.1), *late])
        relayed, delayed = carried_of(counted)
        assert relayed["/cmd_vel"][0] == delayed["/cmd_vel"][0] == step + 1
        assert not late or (relayed["/late"][0] == delayed["/late"][0] == step - 50)
        for found in (relayed, delayed):
            assert len(found) <= 9
            assert sum(name.startswith("/guest") for name in found) <= 6
        shown: dict[str, float] = {f"{name} 0": row[0] for name, row in relayed.items()}
        shown |= {f"{name} 1": row[0] for name, row in delayed.items()}
        assert all(shown[name] >= value for name, value in before.items() if name in shown)
        gone = before.keys() - shown.keys()
        assert all(name.partition(" ")[0].removeprefix("/") not in live for name in gone)
        before = shown
    assert counted.total.messages == sum(row[0] for row in carried_of(counted)[0].values())


def test_a_publishers_md5sum_is_known_once_a_relay_has_seen_its_header() -> None:
    registry = Registry()
    node = incarnation("/node", key="k")
    registry.add(node)
    registry.register(node, Kind.PUBLICATION, "/a", "std_msgs/String")
    counted = RelayTraffic(FakeTrail(), registry, 1, lambda _node, _topic: None)
    assert published_now(registry, counted) == {"/a": {"/node": LiveType("std_msgs/String")}}
    for md5sum in ("992c", ""):
        counted.reported([TopicTraffic("k", "/a", 1, 1, 0, 1, md5sum=md5sum)])
        assert published_now(registry, counted) == {"/a": {"/node": LiveType("std_msgs/String", "992c")}}


def test_a_topic_moves_for_a_minute_after_its_last_message() -> None:
    """In the first minute every topic counts as moving, because an earlier control may have seen messages."""
    registry = Registry()
    registry.add(incarnation("/n", key="k"))
    counted = RelayTraffic(FakeTrail(), registry, 1, lambda _node, _topic: None)
    seen = []
    for messages in (None, None, 1, 0, None):
        if messages is not None:
            counted.reported([TopicTraffic("k", "/a", messages, 1, 0, 1)])
        seen.append(counted.moving("k", "/a"))
        let_time_pass(61.0 if messages is None else 30.0)
    assert seen == [True, False, True, True, False]
