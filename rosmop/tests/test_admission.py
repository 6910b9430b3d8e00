"""First, awaited, held and resumed messages: the module judges as the interpreter does.

The acts around the messages are random: two sets take the same ones, and one has a module.
"""

from collections import Counter
from collections.abc import Callable
from functools import partial
from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st

from rosmop.check.sources import compiled_from
from rosmop.form.compiled import Compiled
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import SEQ, MessageSender
from rosmop.tests.acting import definitions, message
from rosmop.tests.both_ways import state_of
from rosmop.tests.interpreted import beside, check_same
from rosmop.tests.on_module import on_module

SCAN = "/scan sensor_msgs/LaserScan '{ranges:r}'"
TWIST = "/cmd_vel geometry_msgs/Twist"
SAFE = "safe geometry_msgs/Twist { } on /cmd_vel every 100ms;"
SPECIFICATIONS = {
    "begins.rv": f"""begin begins() {{ {SAFE} double near = 0; int strangers = 0; std::string source;
        event scan(std::vector<float> r) {SCAN} when (source == "" || caller(scan) == source) {{ source = caller(scan);
            near = INFINITY; for (int i = 0; i < r.size(); i++) {{ if (r[i] < near) {{ near = r[i]; }} }} }}
        event foreign(std::vector<float> r) {SCAN} when (source != caller(foreign)) {{ strangers++; }}
        event drive(double v) {TWIST} '{{linear.x:v}}' {{ if (near < 1 || age(scan) > 0.5) {{ STOP; }} }}
        event tick() every 70ms {{ if (strangers > 9) {{ strangers = 0; STOP; }} }} }}""",
    "speakers.rv": f"""begin speakers() {{ {SAFE} std::vector<std::string> names; int heard = 0;
        event scan(float a) /scan sensor_msgs/LaserScan '{{angle_min:a}}' {{ if (caller(scan) != "") {{ heard++; }} }}
        event drive(double v) {TWIST} '{{linear.x:v}}' {{ if (heard > 5 && v > 1) {{ v = 1; }} }}
        event tick() every 110ms {{ names.push_back("x"); if (names.size() > 3) {{ names.clear(); }} }} }}""",
    "holds.rv": f"""hold holds() {{ int n = 0;
        event scan(std::vector<float> r) {SCAN} {{ n += r.size(); if (n > 40) {{ ROS_WARN("many"); n = 0; }} }}
        event drive(double v) {TWIST} '{{linear.x:v}}' {{ if (v > 3) {{ return; }} }} }}""",
    "steps.rv": f"""steps() {{ event many(std::vector<float> r) {SCAN} when (r.size() > 2) {{ }}
        event few(std::vector<float> r) {SCAN} when (r.size() <= 2) {{ }}
        fsm: one [ many -> two few -> one ] two [ many -> three few -> one ] three [ many -> three few -> one ]
        @three {{ ROS_INFO("three"); }} }}""",
}  # fmt: skip


def sets_of(compiled: Compiled, *, shadows: bool) -> list[MonitorSet]:
    """Return the same monitors with and without a module."""
    tried = ["steps"] if shadows else []
    module = on_module(compiled, shadows=tried)
    plain = MonitorSet.of(compiled, shadows=tried) if shadows else beside(module)
    for one in (module, plain):
        one.name_senders(lambda source: (f"10.0.0.{source}", f"/node{source}"))
    return [module, plain]


def tell(
    sets: list[MonitorSet], topic: str, data: bytes, now: int, sender: MessageSender, *, judged: bool
) -> str:
    outcomes = [(one.judge if judged else one.process)(topic, bytearray(data), now, sender) for one in sets]
    check_same(*outcomes)
    copies = [[*one.tapped] for one in sets]
    for one in sets:
        one.tapped.clear()
    assert [copy[1:] for copy in copies[0]] == [copy[1:] for copy in copies[1]]
    for mine, other in zip(*copies, strict=True):
        check_same(mine.give(sender), other.give(sender))
    return outcomes[0].reason or ("fault" if outcomes[0].faults else outcomes[0].result)


def check(sets: list[MonitorSet]) -> None:
    module, plain = ([*one.monitors, *one.shadowed] for one in sets)
    for pair in zip(module, plain, strict=True):
        mine, other = (
            (
                one.seen, one.held, one.broken, one.faults, one.enabled, one.awaits, one.starting, one.blocks,
                [(timer.due, timer.ticked) for timer in one.timers],
                [(vars_of(source)) for source in one.sources.values()],
            )
            for one in pair
        )  # fmt: skip
        assert mine == other
    assert state_of(sets[0]) == state_of(sets[1])
    assert sets[0].next_due == sets[1].next_due


def vars_of(source: object) -> list[object]:
    return [getattr(source, name) for name in ("first", "unreadable", "waits", "speakers", "known")]


def act(sets: list[MonitorSet], made: Callable[[], list[MonitorSet]], now: int, choice: Random) -> str:
    """Do something to both sets; return what became of a message."""
    name = choice.choice(["begins", "speakers", "holds"])
    which, judged = choice.randrange(12), choice.random() < 0.5
    if which < 5:
        ranges = [choice.choice([0.5, 2.0, 9.0]) for _ in range(choice.randrange(6))]
        data = message("sensor_msgs/LaserScan", ranges=ranges) if choice.random() < 0.9 else b"\1\2\3"
        sender = MessageSender(choice.choice([1, 1, 1, 2, 3]), 0, SEQ)
        return tell(sets, "/scan", data, now, sender, judged=judged)
    if which < 8:
        data = message("geometry_msgs/Twist", linear__x=choice.choice([0.0, 0.5, 2.0, 4.0]))
        return tell(sets, "/cmd_vel", data, now, MessageSender(4), judged=judged)
    enabled, how = choice.random() < 0.6, choice.randrange(3)
    after = made() if which == 11 else sets
    for place, one in enumerate([*sets]):
        if which == 8:
            one.hold(one.monitor(name), "test")
        elif which == 9:
            one.resume(name)
        elif which == 10:
            one.switch({name: enabled}, now)
            one.take_restarted()
        elif how == 0:
            after[place].succeed(one, now)
        else:
            groups = one.kept_groups() if how == 1 else []
            kept = [(group.names, group.layout, group.base(), group.cells() or None) for group in groups]
            after[place].recover(kept, {} if kept else {"": "lost"}, now, restarted=True)
    sets[:] = after
    return ""


def run(seed: int, *, shadows: bool) -> Counter[str]:
    choice, now, came = Random(seed), 0, Counter[str]()  # noqa: S311  draws examples, not keys
    made = partial(sets_of, compiled_from(SPECIFICATIONS, definitions()), shadows=shadows)
    sets = made()
    for one in sets:
        one.start(0)
    for _ in range(40):
        now += choice.choice([0, 1, 10**7, 10**8])
        came[act(sets, made, now, choice)] += 1
        check(sets)
    return came


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1 << 30), shadows=st.booleans())
def test_the_module_admits_messages_as_the_interpreter_does(seed: int, shadows: bool) -> None:
    run(seed, shadows=shadows)


def test_the_acts_reach_every_outcome() -> None:
    came = sum((run(seed, shadows=False) for seed in range(14)), Counter())
    assert {"passed", "dropped", "changed", "fault"} <= came.keys()
    assert any("until it is resumed" in one for one in came)
    assert any("until it has heard" in one for one in came)
