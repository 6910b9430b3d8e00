from dataclasses import replace
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.base import clock
from appliance.channel.messages import SpecificationsStated, StateGiven, StateLeft, StateWanted
from appliance.relay.monitors import state_keeper
from appliance.relay.monitors.state_keeper import StateKeeper, received_states, start_outcome, state_left
from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.tests.interpreted import check_same
from rosmop.tests.on_module import on_module
from rosmop.tests.random_specifications import Messages, Specifications, definitions
from roswire.standard import standard_definitions
from tests.support.examples import examples
from tests.support.virtual_clock import let_time_pass

FEW = settings(max_examples=examples(120), suppress_health_check=list(HealthCheck), deadline=None)
SIZE = 1 << 20
GIVEN = StateGiven(True, "boot", 1_789_999_000_000_000_000)

STOP = """{modifier} stop() {{
    bool pressed = false; {more}
    event button(bool on) /stop std_msgs/Bool '{{data:on}}' {{ pressed = on; }}
    event drive() /drive std_msgs/Bool '{{}}' {{ if (pressed) {{ return; }} }}
}}"""


def begun(monitors: MonitorSet, memory: bytearray, given: StateGiven = GIVEN) -> StateKeeper:
    keeper = StateKeeper(given, memory)
    left = keeper.recover()
    if left is None:
        monitors.start(0)
    else:
        monitors.recover(left.groups, left.lost, 0)
    keeper.take(monitors)
    return keeper


def again(monitors: MonitorSet) -> MonitorSet:
    return on_module(monitors.compiled, monitors.on_fault)


def unexplained(outcome: Outcome) -> Outcome:
    outcome.verdicts = tuple(replace(verdict, why=None) for verdict in outcome.verdicts)
    outcome.log = []
    outcome.before = [unexplained(before) for before in outcome.before]
    return outcome


@FEW
@given(seed=st.integers(0, 1 << 30), step_ns=st.sampled_from([1, 700_000]))
def test_random_specifications_go_on_where_a_killed_process_was(seed: int, step_ns: int) -> None:
    random = Random(seed)  # noqa: S311  draws examples, not keys
    sources = {f"{place}.rv": text for place, text in enumerate(Specifications(seed).texts())}
    messages = Messages(seed)
    traffic = [(one.topic, body) for one in (messages.traffic() for _ in range(6)) for body in one.bodies()]
    try:
        monitors = on_module(compiled_from(sources, definitions()))
    except SpecificationError:
        return  # the random text is not a valid specification
    whole, memory = again(monitors), bytearray(SIZE)
    whole.start(0)
    keeper = begun(monitors, memory)
    for number, (topic, body) in enumerate(traffic):
        now = number * step_ns
        if random.random() < 0.2:
            monitors = again(monitors)
            keeper = begun(monitors, memory)
            assert monitors.began == ()
        mine, other = (one.judge(topic, bytearray(body), now) for one in (monitors, whole))
        keeper.keep_all() if mine.before else keeper.keep(topic)
        check_same(unexplained(mine), unexplained(other))
    for specification in monitors.compiled.specifications:
        for variable in specification.variables:
            known, found = (each.value(specification.name, variable) for each in (monitors, whole))
            assert repr(known) == repr(found)


def stop(modifier: str = "", more: str = "") -> MonitorSet:
    text = STOP.format(modifier=modifier, more=more)
    return on_module(compiled_from({"stop.rv": text}, standard_definitions()))


def press(monitors: MonitorSet, keeper: StateKeeper) -> None:
    for on in (b"\x00", b"\x01"):
        monitors.judge("/stop", on, 1)
        keeper.keep("/stop")


def drives(monitors: MonitorSet) -> str:
    return monitors.judge("/drive", b"\x01", 2).result


OTHERS = {
    "a power cut": StateGiven(True, "another boot", GIVEN.offset),
    "the clock was set": StateGiven(True, "boot", GIVEN.offset + 3_000_000_000),
    "the clock was set back": StateGiven(True, "next", GIVEN.offset, "boot", GIVEN.offset + 10**18),
}


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("modifier", ["", "hold", "begin"])
def test_a_state_that_may_be_stale_is_not_used(other: str, modifier: str) -> None:
    memory = bytearray(SIZE)
    first = stop(modifier)
    press(first, begun(first, memory))
    second = stop(modifier)
    begun(second, memory, OTHERS[other])
    assert second.began == ("stop",)
    assert drives(second) == ("passed" if modifier == "begin" else "dropped")
    assert bool(second.monitor("stop").why_held) is (modifier != "begin")


def test_an_orderly_end_outlives_the_machine() -> None:
    memory = bytearray(SIZE)
    first = stop()
    press(first, begun(first, memory))
    second = stop()
    begun(second, memory, StateGiven(True, "next", GIVEN.offset, "boot", GIVEN.offset + clock.now_ns()))
    assert second.began == ()
    assert drives(second) == "dropped"
    assert not second.monitor("stop").held


def test_another_text_loses_the_state_and_says_so() -> None:
    memory = bytearray(SIZE)
    first = stop()
    press(first, begun(first, memory))
    second = stop(more="int other = 1;")
    begun(second, memory)
    assert drives(second) == "dropped"
    assert "changed" in second.monitor("stop").why_held
    new = MonitorSet.of(
        compiled_from(
            {"other.rv": STOP.format(modifier="", more="").replace("stop()", "other()")},
            standard_definitions(),
        )
    )
    begun(new, memory)
    assert drives(new) == "passed"


def test_held_topics_are_held_by_the_next_process() -> None:
    memory = bytearray(SIZE)
    first = stop()
    press(first, begun(first, memory))
    for _ in range(3):
        second = stop()
        keeper = begun(second, memory, OTHERS["a power cut"])
        assert second.monitor("stop").held
    second.resume("stop")
    keeper.keep_all()
    third = stop()
    begun(third, memory, OTHERS["a power cut"])
    assert not third.monitor("stop").held


def test_an_unreadable_memory_does_not_start_monitors_over() -> None:
    """A damaged memory does not reveal its monitors, so all monitors that act by a state hold their topics."""
    memory = bytearray(SIZE)
    first = stop()
    press(first, begun(first, memory))
    memory[16:40] = b"\xff" * 24
    second = stop()
    begun(second, memory)
    assert drives(second) == "dropped"
    assert "cannot be read" in second.monitor("stop").why_held


def test_a_newer_state_that_is_lost_is_not_replaced_by_an_older_one() -> None:
    older, newer = bytearray(SIZE), bytearray(SIZE)
    first = stop()
    begun(first, older)
    let_time_pass(1)
    press(second := stop(), begun(second, newer, OTHERS["a power cut"]))
    for memories in ([older, newer], [newer, older]):
        keeper = StateKeeper(GIVEN, bytearray(SIZE), memories)
        left = keeper.recover()
        assert left is not None
        third = stop()
        third.recover(left.groups, left.lost, 0)
        assert third.monitor("stop").held


SLICED = """
goals(std::string id) {
    int total = 0; static int all = 0; bool late = false;
    creation event goal(std::string id) /goal std_msgs/String '{data:id}' { total = total + 1; all = all + 1; }
    event done(std::string id) /done std_msgs/String '{data:id}' { if (late) { return; } total = total + all; }
    event look() every 3ms { if (total > 5) { late = true; } }
    PROPERTY
}
"""
PROPERTIES = (
    "fsm: a [ goal -> b, default a ] b [ goal -> c, done -> d, default b ] c [ default c ] d [ default d ]\n"
    '@c { ROS_WARN("twice"); } @d { }',
    "pattern: globally: goal causes done within 4ms\n@violation { total = 100; }",
    "mtl: goal -> eventually[0,5ms] done\n@violation { late = true; }",
    "ptltl: done -> <*> goal\n@violation { DROP; }",
    "",
)


@pytest.mark.parametrize("shown", PROPERTIES)
@pytest.mark.parametrize("seed", range(examples(24)))
def test_slices_go_on_where_a_killed_process_had_them(shown: str, seed: int) -> None:
    random = Random(seed)  # noqa: S311  draws examples, not keys
    monitors = MonitorSet.of(
        compiled_from({"s.rv": SLICED.replace("PROPERTY", shown)}, standard_definitions())
    )
    whole, memory = again(monitors), bytearray(4 * SIZE)
    whole.start(0)
    keeper = begun(monitors, memory)
    now = 0
    for _ in range(150):
        now += random.choice((0, 100_000, 900_000, 6_000_000))
        if random.random() < 0.1:
            monitors = again(monitors)
            keeper = begun(monitors, memory)
            assert monitors.began == ()
        topic, name = random.choice(("/goal", "/goal", "/done")), b"g%d" % random.randrange(12)
        body = len(name).to_bytes(4, "little") + name
        mine, other = (one.judge(topic, bytearray(body), now) for one in (monitors, whole))
        keeper.keep_all() if mine.before else keeper.keep(topic)
        check_same(unexplained(mine), unexplained(other))
        live = [one.monitor("goals").slices for one in (monitors, whole)]
        assert live[0] is not None
        assert live[1] is not None
        assert live[0].live == live[1].live


def test_many_slices_are_kept_and_a_message_writes_a_part_of_them() -> None:
    text = SLICED.replace("PROPERTY", PROPERTIES[0]).replace("event look() every 3ms", "void look()")
    monitors = MonitorSet.of(compiled_from({"s.rv": text}, standard_definitions()))
    memory = bytearray(8 * SIZE)
    keeper = begun(monitors, memory)
    for number in range(2_000):
        name = b"g%d" % number
        monitors.judge("/goal", len(name).to_bytes(4, "little") + name, number)
    keeper.keep("/goal")
    before = bytes(memory)
    monitors.judge("/done", b"\x02\0\0\0g7", 20_000)
    keeper.keep("/done")
    changed = sum(one != other for one, other in zip(before, memory, strict=True))
    assert 0 < changed < 10_000
    second = again(monitors)
    begun(second, memory)
    slices = second.monitor("goals").slices
    assert slices is not None
    assert slices.live == 2_000
    small = bytearray(SIZE // 8)
    StateKeeper(GIVEN, small).take(second)
    third = again(monitors)
    begun(third, small)
    assert "exceed the limit" in third.monitor("goals").why_held


def test_the_other_appliance_goes_on_with_the_state_that_was_left() -> None:
    first = stop()
    keeper = begun(first, bytearray(SIZE))
    press(first, keeper)
    second = stop()
    received = received_states([b"", keeper.content()])
    second.recover(received.groups, received.lost, 0)
    assert second.began == ()
    assert drives(second) == "dropped"
    assert not second.monitor("stop").held


COPY = StateWanted(7, copy=True)


@pytest.mark.parametrize("modifier", ["", "hold"])
def test_the_other_appliance_goes_on_with_a_copy(modifier: str) -> None:
    first = stop(modifier)
    keeper = begun(first, bytearray(SIZE))
    press(first, keeper)
    copy = state_left(COPY, keeper)
    assert copy.at and copy.content
    for monitors, held in ((stop(modifier), bool(modifier)), (other_stop(), True)):
        stated = SpecificationsStated(
            1, b"", {}, restarted=True, lost="gone", left=(copy.content,), left_at=copy.at
        )
        start_outcome(monitors, stated, StateKeeper(GIVEN, bytearray(SIZE)), 0, restarted=True)
        assert monitors.monitors[0].held is held


def other_stop() -> MonitorSet:
    text = STOP.format(modifier="", more="").replace("stop()", "late_stop()")
    return on_module(compiled_from({"stop.rv": text}, standard_definitions()))


def test_only_a_changed_state_of_a_bounded_size_is_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    monitors = stop()
    keeper = begun(monitors, bytearray(SIZE))
    for _ in range(2):
        monitors.judge("/stop", b"\x00", 1)
        keeper.keep("/stop")
    assert state_left(COPY, keeper).content
    let_time_pass(2.0)
    copies = [state_left(COPY, keeper)]
    monitors.judge("/stop", b"\x00", 1)
    keeper.keep("/stop")
    copies += [state_left(COPY, keeper), state_left(StateWanted(8, copy=True, full=True), keeper)]
    press(monitors, keeper)
    copies += [state_left(COPY, keeper), state_left(COPY, keeper)]
    assert [copy.content is not None for copy in copies] == [False, False, True, True, False]
    assert {copy.at for copy in copies} == {keeper.offset + clock.now_ns()}
    monkeypatch.setattr(state_keeper, "LARGEST_COPY", 10)
    assert state_left(StateWanted(9, copy=True, full=True), keeper) == StateLeft(9, b"")
    assert state_left(StateWanted(9, copy=True), None) == StateLeft(9, b"")


def test_a_damaged_state_is_lost() -> None:
    first = stop()
    keeper = begun(first, bytearray(SIZE))
    press(first, keeper)
    content = keeper.content()
    second = stop()
    received = received_states([content[: len(content) // 2]])
    second.recover(received.groups, received.lost, 0)
    assert drives(second) == "dropped"
    assert second.monitor("stop").why_held
