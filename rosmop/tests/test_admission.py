"""First, awaited, held and resumed messages: the module judges as the interpreter does.

The acts around the messages are random: two sets take the same ones, and one has a module.
"""

from collections import Counter
from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import NO_NUMBER, SEQ, MessageSender
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


class Pair:
    """The same monitors with and without a module."""

    def __init__(self, shadows: bool) -> None:
        self.compiled = compiled_from(SPECIFICATIONS, definitions())
        self.shadows = ["steps"] if shadows else []
        self.sets: list[MonitorSet] = self.made()
        for one in self.sets:
            one.start(0)
        self.now = 0
        self.came: Counter[str] = Counter()

    def made(self) -> list[MonitorSet]:
        module = on_module(self.compiled, shadows=self.shadows)
        plain = MonitorSet.of(self.compiled, shadows=self.shadows) if self.shadows else beside(module)
        for one in (module, plain):
            one.name_senders(lambda source: (f"10.0.0.{source}", f"/node{source}"))
        return [module, plain]

    def tell(self, topic: str, data: bytes, source: int, *, judged: bool) -> None:
        sender = MessageSender(source, 0, SEQ if topic == "/scan" else NO_NUMBER)
        outcomes = [
            (one.judge if judged else one.process)(topic, bytearray(data), self.now, sender)
            for one in self.sets
        ]
        self.came[outcomes[0].reason or outcomes[0].result if not outcomes[0].faults else "fault"] += 1
        check_same(*outcomes)
        copies = [[*one.tapped] for one in self.sets]
        for one in self.sets:
            one.tapped.clear()
        assert [copy[1:] for copy in copies[0]] == [copy[1:] for copy in copies[1]]
        for mine, other in zip(*copies, strict=True):
            check_same(mine.give(sender), other.give(sender))

    def check(self) -> None:
        module, plain = ([*one.monitors, *one.shadowed] for one in self.sets)
        for mine, other in zip(module, plain, strict=True):
            told = [
                (
                    one.seen, one.held, one.broken, one.faults, one.enabled, one.awaits, one.starting, one.blocks,
                    [(timer.due, timer.ticked) for timer in one.timers],
                    [(vars_of(source)) for source in one.sources.values()],
                )
                for one in (mine, other)
            ]  # fmt: skip
            assert told[0] == told[1]
        assert state_of(self.sets[0]) == state_of(self.sets[1])
        assert self.sets[0].next_due == self.sets[1].next_due


def vars_of(source: object) -> list[object]:
    return [getattr(source, name) for name in ("first", "unreadable", "waits", "speakers", "known")]


def act(pair: Pair, choice: Random) -> None:
    name = choice.choice(["begins", "speakers", "holds"])
    which = choice.randrange(12)
    pair.now += choice.choice([0, 1, 10**7, 10**8])
    if which < 5:
        ranges = [choice.choice([0.5, 2.0, 9.0]) for _ in range(choice.randrange(6))]
        data = message("sensor_msgs/LaserScan", ranges=ranges) if choice.random() < 0.9 else b"\1\2\3"
        pair.tell("/scan", data, choice.choice([1, 1, 1, 2, 3]), judged=choice.random() < 0.5)
    elif which < 8:
        data = message("geometry_msgs/Twist", linear__x=choice.choice([0.0, 0.5, 2.0, 4.0]))
        pair.tell("/cmd_vel", data, 4, judged=choice.random() < 0.5)
    elif which == 8:
        for one in pair.sets:
            one.hold(one.monitor(name), "test")
    elif which == 9:
        for one in pair.sets:
            one.resume(name)
    elif which == 10:
        enabled = choice.random() < 0.6
        for one in pair.sets:
            one.switch({name: enabled}, pair.now)
            one.take_restarted()
    else:
        kept = [
            [(group.names, group.layout, group.base(), group.cells() or None) for group in one.kept_groups()]
            for one in pair.sets
        ]
        before, pair.sets = pair.sets, pair.made()
        how = choice.randrange(3)
        for one, old, state in zip(pair.sets, before, kept, strict=True):
            if how == 0:
                one.succeed(old, pair.now)
            else:
                one.recover(
                    state if how == 1 else [], {} if how == 1 else {"": "lost"}, pair.now, restarted=True
                )


def run(seed: int, *, shadows: bool) -> Counter[str]:
    choice = Random(seed)  # noqa: S311  draws examples, not keys
    pair = Pair(shadows)
    for _ in range(40):
        act(pair, choice)
        pair.check()
    return pair.came


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1 << 30), shadows=st.booleans())
def test_the_module_admits_messages_as_the_interpreter_does(seed: int, shadows: bool) -> None:
    run(seed, shadows=shadows)


def test_the_acts_reach_every_outcome() -> None:
    came = sum((run(seed, shadows=False) for seed in range(14)), Counter())
    assert {"passed", "dropped", "changed", "fault"} <= came.keys()
    assert any("until it is resumed" in one for one in came)
    assert any("until it has heard" in one for one in came)
