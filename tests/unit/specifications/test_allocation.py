import json

import pytest

from appliance.specifications.allocation import SERVICE, TOPIC, Allocation, Move, groups_of
from appliance.specifications.checking import check
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
)


def spec(name: str, *topics: str, body: str = "", variables: str = "") -> str:
    events = "".join(
        f"event e{number}() {topic} std_msgs/String '{{}}' {{ {body} }}"
        for number, topic in enumerate(topics)
    )
    return f"{name}() {{ {variables} {events} }}"


def checked(**files: str) -> CheckedSpecifications:
    return check(Sources({f"{name}.rv": text for name, text in files.items()}), ())


def together(**files: str) -> list[set[str]]:
    return [{name.removesuffix(".rv") for name in group.files} for group in groups_of(checked(**files))]


def test_specifications_without_anything_in_common_are_apart() -> None:
    two = spec("b", "/b") + spec("c", "/c")
    assert together(a=spec("a", "/a"), b=two, d=spec("d", "/d")) == [{"b"}, {"a"}, {"d"}]


@pytest.mark.parametrize(
    "other",
    [
        spec("b", "/b", "/a"),
        spec("b", "/b", body="n++;"),
        spec("b", "/b", variables="std_msgs::String s;", body="PUBLISH(/a, std_msgs/String, s);"),
    ],
    ids=["topic", "variable", "publishes onto the other's topic"],
)
def test_common_topics_join_specifications(other: str) -> None:
    a = spec("a", "/a", variables="int n;")
    assert together(a=a, b=other) == [{"a", "b"}]
    assert together(a=a, b=other, c=spec("c", "/c", "/b")) == [{"a", "b", "c"}]


def test_a_file_with_nothing_but_an_order_needs_no_relay() -> None:
    code = checked(a=spec("a", "/a"), b=spec("b", "/b"), order="order b < a;")
    assert ([*code.monitors], [{*group.files} for group in groups_of(code)]) == (
        ["b", "a"],
        [{"a.rv"}, {"b.rv"}],
    )


def test_a_service_joins_but_a_topic_of_the_same_name_does_not() -> None:
    service = "NAME() { event e() service /x std_srvs/SetBool request '{}' { } }"
    topic = spec("t", "/x")
    joined = together(a=service.replace("NAME", "a"), b=service.replace("NAME", "b"), t=topic)
    assert joined == [{"a", "b"}, {"t"}]


def test_a_fresh_start_is_balanced_and_kept() -> None:
    kept: list[str] = []
    first = Allocation(2, kept.append)
    names = "abcd"
    both = checked(**{name: spec(name, f"/{name}") for name in names})
    first.adopt(first.plan(both))
    relays = [first.of_file(f"{name}.rv") for name in names]
    assert sorted(relays) == [0, 0, 1, 1]
    assert [first.of(TOPIC, f"/{name}") for name in names] == relays
    second = Allocation(2)
    assert second.restore(kept[-1])
    assert [second.of(TOPIC, f"/{name}") for name in names] == relays
    assert not Allocation(3).restore(kept[-1])
    for broken in ("", "[]", "{}", json.dumps({"relays": 2, "files": 1, "resources": []})):
        assert not Allocation(2).restore(broken)


def test_a_specification_goes_to_the_relay_of_its_topics() -> None:
    allocation = Allocation(4)
    here = {f"/t{number}": allocation.of(TOPIC, f"/t{number}") for number in range(64)}
    assert set(here.values()) == {0, 1, 2, 3}
    carried = {(TOPIC, topic) for topic in here}
    for topic in list(here)[:8]:
        assert allocation.plan(checked(a=spec("a", topic)), carried).moves == ()
    on = [[topic for topic, relay in here.items() if relay == one] for one in range(2)]
    plan = allocation.plan(checked(a=spec("a", *on[0][:2], on[1][0])), carried)
    assert plan.moves == (Move(TOPIC, on[1][0], 1, 0),)
    allocation.adopt(plan)
    after = allocation.plan(CheckedSpecifications(), carried)
    assert after.moves == ()
    assert allocation.plan(CheckedSpecifications(), set()).resources == {}


def test_running_monitors_move_only_when_they_must() -> None:
    allocation = Allocation(2)
    first = {"a": spec("a", "/a") + spec("a2", "/a"), "b": spec("b", "/b")}
    allocation.adopt(allocation.plan(checked(**first)))
    assert allocation.of_file("a.rv") != allocation.of_file("b.rv")
    joined = checked(**first, c=spec("c", "/a", "/b", "/c"))
    carried = {(TOPIC, "/b"), (SERVICE, "/b")}
    plan = allocation.plan(joined, carried)
    assert plan.moved_files == {"b.rv"}
    assert [(move.kind, move.name) for move in plan.moves] == [(TOPIC, "/b")]
    allocation.adopt(plan)
    assert allocation.plan(checked(**first), carried).moved_files == frozenset()


def test_topics_move_in_one_direction() -> None:
    allocation = Allocation(2)
    first = {name: spec(name, f"/{name}") for name in "abcd"}
    allocation.adopt(allocation.plan(checked(**first)))
    assert [allocation.of_file(f"{name}.rv") for name in "abcd"] == [0, 1, 0, 1]
    crossed = checked(**first, x=spec("x", "/a", "/b"), y=spec("y", "/c", "/d"))
    carried = {(TOPIC, f"/{name}") for name in "abcd"}
    plan = allocation.plan(crossed, carried)
    assert {move.target for move in plan.moves} == {0}
    assert (plan.moved_files, plan.losing) == (frozenset({"b.rv", "d.rv"}), frozenset({1}))
    assert set(plan.files.values()) == {0}


def test_a_relay_whose_topic_gets_its_monitor_elsewhere_gives_something_up() -> None:
    allocation = Allocation(2)
    files = {"a": spec("a", "/a"), "b": spec("b", "/b")}
    allocation.adopt(allocation.plan(checked(**files)))
    changed = checked(a=spec("a", "/other"), b=spec("b", "/b", "/a"))
    plan = allocation.plan(changed, {(TOPIC, "/a"), (TOPIC, "/b")})
    assert (plan.moves, plan.moved_files, plan.losing) == (
        (Move(TOPIC, "/a", 0, 1),),
        frozenset[str](),
        frozenset({0}),
    )
