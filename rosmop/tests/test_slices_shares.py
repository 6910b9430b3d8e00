"""Slices are charged to the hosts whose messages create them: no host uses up the number or time of others."""

# ruff: noqa: E501  the rows of tables

from itertools import count
from random import Random

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import TICK_BUDGET, OnFault
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.run.slices import TOGETHER_LIMIT, Binding, Slices
from rosmop.tests.acting import definitions, message
from rosmop.tests.examples import examples

ROBOT, GUEST = MessageSender(1), MessageSender(2)
HOSTS = {1: "10.0.0.1", 2: "10.0.0.2", 3: "10.0.0.3", 4: "10.0.0.4"}
GOALS = """goals(std::string id) {
    creation event goal(std::string id) /goal std_msgs/String '{data:id}' { }
    event result(std::string id) /result std_msgs/String '{data:id}' { }
    fsm: new [ goal -> sent, default new ] sent [ goal -> twice, result -> done ] twice [ result -> done, default twice ]
         done [ default done ]
    @twice { %s }
}"""
ACTING, OBSERVING = GOALS % "DROP;", GOALS % 'ROS_WARN("twice");'


def begun(text: str, slices: int) -> MonitorSet:
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, definitions()), slices=slices, holder_of=HOSTS.get)
    monitors.start(0)
    return monitors


def send(monitors: MonitorSet, topic: str, name: str, sender: MessageSender, time: int = 1) -> Outcome:
    return monitors.process(topic, message("std_msgs/String", data=name), time, sender)


def live(monitors: MonitorSet) -> int:
    slices = monitors.monitors[0].slices
    assert slices is not None
    return slices.live


def of_host(slices: Slices, host: str) -> list[Binding]:
    return [binding for holder, binding in slices.quota.all() if holder == host]


def test_a_guest_that_makes_up_ids_refuses_the_robot_nothing() -> None:
    monitors = begun(ACTING, 100)
    assert not send(monitors, "/goal", "r", ROBOT).faults
    outcomes = [send(monitors, "/goal", f"g{number}", GUEST) for number in range(1000)]
    assert [bool(outcome.faults) for outcome in outcomes] == [False] * 49 + [True] * 951
    assert outcomes[-1].result == "dropped"
    assert outcomes[-1].faults[0].values == {"id": "g999"}
    for number in range(20):
        assert not send(monitors, "/goal", f"r{number}", ROBOT).faults
    assert send(monitors, "/goal", "r", ROBOT).verdicts
    assert send(monitors, "/goal", "g0", GUEST).verdicts  # its debt is not forgotten


def test_a_guest_that_makes_up_ids_pushes_out_its_own() -> None:
    monitors = begun(OBSERVING, 100)
    send(monitors, "/goal", "r", ROBOT)
    outcomes = [send(monitors, "/goal", f"g{number}", GUEST) for number in range(1000)]
    assert not any(outcome.faults or outcome.result == "dropped" for outcome in outcomes)
    assert [line.text for outcome in outcomes for line in outcome.log] == [
        "1 of its oldest slices were removed to make room for new ones of the same host; the limit is 100 slices"
    ]
    assert live(monitors) == 50
    assert send(monitors, "/goal", "r", ROBOT).verdicts
    assert not send(monitors, "/goal", "g0", GUEST).verdicts
    assert send(monitors, "/goal", "g999", GUEST).verdicts


def test_hosts_that_are_not_told_apart_have_the_whole() -> None:
    monitors = begun(ACTING, 100)
    for number in range(100):
        assert not send(monitors, "/goal", str(number), MessageSender(9)).faults
    assert send(monitors, "/goal", "more", MessageSender(9)).faults


@pytest.mark.parametrize("text", [ACTING, OBSERVING])
def test_no_sequence_removes_a_slice_for_another_host(text: str) -> None:
    for seed in range(examples(60)):
        random = Random(seed)  # noqa: S311  draws examples, not keys
        monitors = begun(text, 12)
        for _ in range(80):
            slices = monitors.monitors[0].slices
            assert slices is not None
            before = {host: of_host(slices, host) for host in HOSTS.values()}
            host = random.choice((*HOSTS,))
            send(
                monitors,
                random.choice(("/goal", "/goal", "/result")),
                f"{host} {random.randrange(9)}",
                MessageSender(host),
            )
            after = {host: of_host(slices, host) for host in HOSTS.values()}
            assert slices.live == sum(map(len, after.values())) <= 12
            assert all(after[other] == before[other] for other in HOSTS.values() if other != HOSTS[host])


def test_a_guest_has_no_binding_of_the_robot_forgotten() -> None:
    monitors = begun(ACTING, 10)
    send(monitors, "/goal", "r", ROBOT)
    send(monitors, "/result", "r", ROBOT)
    for number in range(100):
        send(monitors, "/goal", f"g{number}", GUEST)
        send(monitors, "/result", f"g{number}", GUEST)
    send(monitors, "/goal", "r", ROBOT)
    assert live(monitors) == 0


STOPPED = """goals(std::string id) {
    static int most = 1000000; int times = 0;
    creation event goal(std::string id) /goal std_msgs/String '{data:id}' { }
    event stop() /stop std_msgs/Empty '{}' %s
    fsm: new [ goal -> sent, default new ] sent [ goal -> sent, stop -> stopped ] stopped [ goal -> again, stop -> stopped ]
         again [ default again ]
    @again { DROP; }
}"""


def states(monitors: MonitorSet) -> list[object]:
    slices = monitors.monitors[0].slices
    assert slices is not None
    found = [slices.state(binding) for _host, binding in slices.quota.all()]
    return [
        (slice_.runs[0].state, slice_.values)  # type: ignore[attr-defined]  # of tables
        for slice_ in found
        if slice_ is not None and slices.is_whole(slice_)
    ]


def test_one_message_concerns_a_bounded_number_of_slices() -> None:
    monitors = begun(STOPPED % "{ }", 100_000)
    for number in range(TOGETHER_LIMIT):
        send(monitors, "/goal", str(number), MessageSender(9))
    assert live(monitors) == TOGETHER_LIMIT
    assert send(monitors, "/goal", "more", MessageSender(9)).faults
    assert not monitors.process("/stop", b"", 2, GUEST).faults
    assert len({repr(state) for state in states(monitors)}) == 1


@pytest.mark.parametrize("on_fault", ["drop", "pass"])
def test_a_message_that_is_cut_has_happened_in_no_slice(on_fault: OnFault) -> None:
    action = '{ times = times + 1; ROS_INFO("stop"); for (int i = 0; i < 300000; i++) { times = times; } }'
    monitors = MonitorSet.of(compiled_from({"x.rv": STOPPED % action}, definitions()), on_fault)
    monitors.start(0)
    for name in "abcde":
        send(monitors, "/goal", name, GUEST)
    before = states(monitors)
    outcome = monitors.process("/stop", b"", 2, GUEST)
    assert outcome.result == ("dropped" if on_fault == "drop" else "passed")
    assert (len(outcome.faults), outcome.verdicts, [*outcome.log], outcome.events) == (1, (), [], ())
    assert states(monitors) == before


def test_output_that_is_discarded_leaves_its_place_due() -> None:
    """A slice that lacks a parameter, and a message that is cut, print nothing: what `_ONCE` prints is still to come."""
    text = """s(std::string id, int n) {
        event a(std::string id) /a std_msgs/String '{data:id}' { ROS_WARN_ONCE("first"); ROS_WARN_THROTTLE(10, "now"); }
        event b(int n) /b std_msgs/Int32 '{data:n}' { }
        event stop(int more) /stop std_msgs/UInt32 '{data:more}' { ROS_INFO_ONCE("stop"); for (int i = 0; i < more; i++) { } }
    }"""
    monitors = begun(text, 1000)

    def lines(topic: str, data: bytes, time: int) -> list[str]:
        return [line.text for line in monitors.process(topic, bytearray(data), time).log]

    a, b, stop = message("std_msgs/String", data="x"), message("std_msgs/Int32", data=1), "std_msgs/UInt32"
    assert (lines("/a", a, 1), lines("/b", b, 2)) == ([], [])
    assert (lines("/a", a, 3), lines("/a", a, 4)) == (["first", "now"], [])
    assert lines("/stop", message(stop, data=400_000), 5) == []
    assert (lines("/stop", message(stop), 6), lines("/stop", message(stop), 7)) == (["stop"], [])


WAITING = """goals(std::string id%s) {
    creation event goal(std::string id) /goal std_msgs/String '{data:id}' { }
    event stop(%s) /stop std_msgs/%s '{%s}' { }
    mtl: goal => eventually[0,60s] stop
    @violation { ROS_WARN("not stopped"); }
    @validation { ROS_INFO("stopped"); }
}"""


@pytest.mark.parametrize("on_fault", ["drop", "pass"])
def test_a_message_that_is_cut_ends_no_wait(on_fault: OnFault) -> None:
    """Waiting events count in the time of a message, and still wait after one that took too long."""
    compiled = compiled_from({"x.rv": WAITING % ("", "", "Empty", "")}, definitions())
    cut, free = MonitorSet.of(compiled, on_fault), MonitorSet.of(compiled, on_fault)
    for monitors in (cut, free):
        monitors.start(0)
        for time in range(900):
            monitors.process("/goal", bytearray(message("std_msgs/String", data="abc"[time % 3])), time)
    cut.limit_time(count(step=0.02).__next__, 0.001)
    for time in (900, 901):
        outcome = cut.process("/stop", b"", time, GUEST)
        assert [fault.over for fault in outcome.faults] == [True]
        assert (outcome.result, outcome.events, outcome.verdicts) == ("passed", (), ())
    cut.limit_time(lambda: 0.0, 0.01)
    time = 60 * 10**9 + 100
    for monitors in (cut, free):
        assert not monitors.process("/goal", bytearray(message("std_msgs/String", data="a")), 902).faults
    ended = [[one.verdicts for one in monitors.advance(time)] for monitors in (cut, free)]
    assert ended[0] == ended[1] and len(ended[0]) == 100
    after = [monitors.process("/stop", b"", time) for monitors in (cut, free)]
    assert after[0].verdicts == after[1].verdicts and len(after[0].verdicts) == 3


def test_a_slice_that_would_copy_too_many_waiting_events_in_the_time_does_not_begin() -> None:
    text = WAITING % (", int n", "std::string id, int n", "Header", "frame_id:id, seq:n")
    monitors = begun(text, 1000)
    for time in range(300):
        monitors.process("/goal", bytearray(message("std_msgs/String", data="a")), time)
    stop = message("std_msgs/Header", frame_id="a", seq=1)
    monitors.limit_time(lambda: 0.0, 0.01)
    outcome = monitors.process("/stop", bytearray(stop), 300)
    assert ([fault.over for fault in outcome.faults], outcome.result, live(monitors)) == ([True], "passed", 1)
    monitors.limit_time(lambda: 0.0, 1)
    assert (monitors.process("/stop", bytearray(stop), 301).faults, live(monitors)) == ((), 2)


def test_slices_of_a_guest_take_no_tick_from_those_of_the_robot() -> None:
    text = """goals(std::string id) {
        static std_msgs::Empty stop; int loops = 0; bool waits = true;
        creation event goal(std::string id, int seq) /goal std_msgs/Header '{frame_id:id, seq:seq}' { loops = seq; }
        event look() every 1s { for (int i = 0; i < loops; i++) { } if (waits) { waits = false; PUBLISH(/stop, std_msgs/Empty, stop); } }
    }"""
    monitors = begun(text, 1000)
    for number in range(200):
        goal = message("std_msgs/Header", frame_id=f"g{number}", seq=2 * TICK_BUDGET)
        monitors.process("/goal", goal, 1, GUEST)
    monitors.process("/goal", message("std_msgs/Header", frame_id="r", seq=0), 1, ROBOT)
    (outcome,) = monitors.advance(10**9 + 1)
    assert [one.topic for one in outcome.published] == ["/stop"]


def test_the_time_limit_of_a_message_grows_with_its_slices() -> None:
    text = STOPPED.replace("@again { DROP; }", '@stopped { ROS_INFO("stopped"); }') % "{ }"
    monitors = begun(text, 1000)
    for number in range(200):
        send(monitors, "/goal", str(number), MessageSender(9))
    turn = monitors.interpreter.turn
    monitors.limit_time(lambda: 12e-6 * len(turn.log), 0.005)
    outcome = monitors.process("/stop", b"", 2, ROBOT)
    assert (len(outcome.verdicts), outcome.faults) == (200, ())


def test_slices_of_a_guest_take_no_time_of_a_tick_from_those_of_the_robot() -> None:
    text = """goals(std::string id) {
        static std_msgs::Empty stop; bool waits = true;
        creation event goal(std::string id) /goal std_msgs/String '{data:id}' { }
        event look() every 1s { for (int i = 0; i < 300; i++) { } if (waits) { waits = false; PUBLISH(/stop, std_msgs/Empty, stop); } }
    }"""
    monitors = begun(text, 1000)
    for number in range(100):
        send(monitors, "/goal", f"g{number}", GUEST)
    send(monitors, "/goal", "r", ROBOT)
    turn = monitors.interpreter.turn
    monitors.limit_time(lambda: 0.004 * len(turn.published), 0.005)
    (outcome,) = monitors.advance(10**9 + 1)
    assert (len(outcome.published), outcome.faults) == (101, ())
