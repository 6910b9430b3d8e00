from collections.abc import Callable
from copy import deepcopy
from typing import Any

import msgspec
import pytest

from appliance.channel.answers.monitor_answers import GivenState
from appliance.specifications.givens import Givens
from appliance.specifications.in_force import (
    InForce,
    Order,
    Return,
    clear,
    confirm,
    give,
    load,
    switch,
)
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
    SpecificationsRefusedError,
)
from appliance.specifications.switches import SHADOW, Switches

SPEED = GivenState("speed", "double", 1.0, "m/s", 1.0, 0.0, 2.0)


def checked(*names: str, sharing: tuple[tuple[str, ...], ...] = ()) -> CheckedSpecifications:
    return CheckedSpecifications(
        monitors={name: f"{name}.rv" for name in names}, sharing=tuple(map(frozenset, sharing)),
        givens=dict.fromkeys(names, (SPEED,)),
    )  # fmt: skip


def sources(*names: str) -> Sources:
    return Sources({f"{name}.rv": name for name in names})


def in_force(*names: str, enable: str = "all", **said: Any) -> InForce:
    return InForce(3, sources(*names), checked(*names), Switches(enable, said), acts=7)


NOW = in_force("a", "b", a=False)
ORDERS: dict[str, Callable[[InForce], object]] = {
    "load": lambda now: load(now, Order(sources("c"), shadow={"c.rv"}), checked("c"), signed=False),
    "switch": lambda now: switch(now, ["b"], SHADOW),
    "set": lambda now: give(now, "a", {"speed": 0.5}),
    "clear": clear,
}


@pytest.mark.parametrize("name", ORDERS)
def test_an_order_leaves_the_earlier_value_as_it_was(name: str) -> None:
    now = deepcopy(NOW)
    ORDERS[name](now)
    assert now == NOW


def test_a_load_keeps_all_switches_and_gives_its_files_theirs() -> None:
    order = Order(sources("a", "b", "c"), shadow={"c.rv"}, constants={"b": {"speed": 0.5}})
    new, _drawn_in, _dropped, put, values = load(NOW, order, checked("a", "b", "c"), signed=False)
    assert (new.tag, new.states) == ("4.7", {"a": False, "b": True, "c": SHADOW})
    assert (put, values, new.givens.said) == ({"c": SHADOW}, {"b": {"speed": 0.5}}, {"b": {"speed": 0.5}})


def test_the_last_words_of_a_revision_are_for_monitors_that_are_not_in_force() -> None:
    order = Order(
        sources("a", "c"),
        switches={"a": SHADOW, "c": False},
        given={"a": {"speed": 0.1}, "c": {"speed": 0.2}},
    )
    new, _drawn_in, _dropped, put, values = load(NOW, order, checked("a", "c"), signed=False)
    assert new.states == {"a": False, "c": False}
    assert (put, values, new.givens.said) == ({}, {}, {"c": {"speed": 0.2}})


def test_a_monitor_in_force_is_not_drawn_into_shadow_mode() -> None:
    contents = checked("b", "c", sharing=(("b", "c"),))
    with pytest.raises(SpecificationsRefusedError, match="do not go together"):
        load(NOW, Order(sources("b", "c"), shadow={"c.rv"}), contents, signed=False)
    now, drawn_in, *_ = load(in_force(), Order(sources("b", "c"), shadow={"c.rv"}), contents, signed=False)
    assert (now.states, now.switches.said, drawn_in) == (
        {"b": SHADOW, "c": SHADOW},
        {"c": SHADOW, "b": SHADOW},
        ["b"],
    )
    with pytest.raises(SpecificationsRefusedError, match="do not go together"):
        switch(now, ["b"], True)
    assert switch(now, ["b", "c"], True).states == {"b": True, "c": True}


def test_nothing_is_kept_about_what_is_not_in_force() -> None:
    new = InForce(
        4, sources("a"), checked("a"), Switches(said={"a": False, "b": False}), Givens({"b": {"speed": 0.1}})
    )
    now, drawn_in, dropped, *_ = clear(new)
    assert (now.switches.said, now.givens.said, drawn_in, dropped) == ({"a": False}, {}, [], [])


def test_a_site_that_signs_lets_no_load_replace_a_topic() -> None:
    topic = GivenState("t", "topic", "/x", "", "/x")
    contents = CheckedSpecifications(monitors={"a": "a.rv"}, givens={"a": (topic,)})
    order = Order(sources("a"), topics={"a": {"t": "/y"}})
    with pytest.raises(SpecificationsRefusedError, match="the site signs"):
        load(NOW, order, contents, signed=True)
    assert load(NOW, order, contents, signed=False).now.number == 4


def test_each_switch_and_value_has_a_tag_of_its_own() -> None:
    tags = [
        NOW.tag,
        switch(NOW, ["b"], False).tag,
        give(give(NOW, "a", {"speed": 0.1}), "a", {"speed": 1.0}).tag,
    ]
    assert tags == ["3.7", "3.8", "3.9"]


def test_timed_switches_return_to_the_switch_before_all_of_them_until_another_order() -> None:
    shadowed = switch(switch(NOW, ["b"], SHADOW), ["b"], True, timed=True)
    assert (shadowed.promoted, shadowed.returns) == (["b"], {"b": Return(SHADOW, True)})
    off = switch(shadowed, ["a", "b"], False, timed=True)
    assert off.returns == {"a": Return(True), "b": Return(SHADOW)}
    assert (switch(off, ["b"], False).returns, confirm(off).returns) == ({"a": Return(True)}, off.returns)
    assert confirm(shadowed).returns == {}
    coming = load(off, Order(sources("a")), checked("a"), signed=False)
    assert coming.now.returns == {"a": Return(True)}


def test_changes_without_a_confirmation_go_back_to_the_last_revision_before_them() -> None:
    def following(now: InForce, within: float | None = None) -> InForce:
        return load(now, Order(sources("a"), within=within), checked("a"), signed=False).now

    waiting = following(following(NOW, 5.0), 5.0)
    assert (waiting.number, waiting.back_to, switch(waiting, ["a"], True).back_to) == (5, 3, 3)
    assert (following(waiting).back_to, confirm(waiting).back_to) == (3, None)
    assert load(waiting, Order(sources("a"), settled=True), checked("a"), signed=False).now.back_to is None


def undone(now: InForce, text: CheckedSpecifications, former: InForce) -> InForce:
    order = Order(former.sources, switches=former.switches.said, given=former.givens.said, undoes=True)
    return load(now, order, text, signed=False).now


def worded(word: str, *names: str) -> CheckedSpecifications:
    return msgspec.structs.replace(checked(*names), switches=dict.fromkeys(names, word))


@pytest.mark.parametrize(("enable", "word"), [("all", "off"), ("all", "shadow"), ("none", "on")])
def test_the_word_of_a_text_that_is_undone_goes_with_it(enable: str, word: str) -> None:
    former = in_force("b", enable=enable)
    now = load(former, Order(sources("b"), within=60.0), worded(word, "b"), signed=False).now
    assert now.states == former.states
    assert undone(now, checked("b"), former).states == former.states


@pytest.mark.parametrize("to", [False, True])
def test_a_timed_switch_returns_to_the_one_before_a_change_that_is_undone(to: bool) -> None:
    former = in_force("b")
    now = load(former, Order(sources("b"), within=60.0, shadow={"b.rv"}), checked("b"), signed=False).now
    timed = switch(now, ["b"], to, timed=True)
    back = undone(timed, checked("b"), former)
    assert (back.states, back.returns) == ({"b": to}, {} if to else {"b": Return(True)})
    ended = switch(timed, ["b"], SHADOW, due=True)
    assert undone(ended, checked("b"), former).states == {"b": True}


def test_an_order_between_two_changes_that_are_undone_goes_with_the_second() -> None:
    former = give(in_force("b"), "b", {"speed": 0.3})
    now = load(former, Order(sources("b"), within=60.0), checked("b"), signed=False).now
    now = give(switch(now, ["b"], False), "b", {"speed": 0.5})
    again = Order(sources("b"), within=60.0, shadow={"b.rv"}, constants={"b": {"speed": 0.7}})
    back = undone(load(now, again, checked("b"), signed=False).now, checked("b"), former)
    assert (back.states, back.givens.said) == ({"b": True}, {"b": {"speed": 0.3}})


def test_a_constant_that_the_former_text_does_not_allow_gives_way_to_the_former_one() -> None:
    wide = msgspec.structs.replace(
        checked("b"), givens={"b": (GivenState("speed", "double", 1.0, "m/s", 1.0, 0.0, 5.0),)}
    )
    former = give(in_force("b"), "b", {"speed": 0.3})
    now = give(load(former, Order(sources("b"), within=60.0), wide, signed=False).now, "b", {"speed": 4.0})
    assert undone(now, checked("b"), former).givens.said == {"b": {"speed": 0.3}}
