"""Bytes that are not a message, on a topic that a guard observes, put it in doubt: it stops what it guards."""

from collections.abc import Callable, Mapping

import pytest

from appliance.features.guards.presets import PRESETS, Guard, text_of
from rosmop.fast.abi import SetPart
from rosmop.run.engine import MonitorSet
from rosmop.run.origins import MAX, Origin
from rosmop.run.outcomes import MessageSender
from rosmop.tests.acting import message
from tests.support.features.guards.running_guard import DEFINITIONS, interpreted, on_its_module, part_of
from tests.support.rows import require_rows

SECOND = 10**9
STILL, DRIVE = message("geometry_msgs/Twist"), message("geometry_msgs/Twist", linear__x=0.4)
ODOMETRY = message("nav_msgs/Odometry", pose__pose__orientation__w=1.0, child_frame_id="base")
SCAN = message("sensor_msgs/LaserScan", range_max=30.0, angle_min=-3.14, angle_increment=0.0174,
               ranges=[9.0 + 0.01 * number for number in range(361)])  # fmt: skip
BATTERY = message("sensor_msgs/BatteryState", percentage=0.9, location="front")
GOOD = {
    "separation": {"by": SCAN},
    "fence": {"by": ODOMETRY},
    "sensor": {"by": SCAN},
    "agree": {"other": ODOMETRY, "by": ODOMETRY},
    "ready": {"by": BATTERY, "fix": message("sensor_msgs/NavSatFix"), "check": message("std_msgs/Bool", data=True)},
    "estop": {"stop": message("std_msgs/Bool"), "reset": message("std_msgs/Bool")},
    "hold_to_run": {"by": message("std_msgs/Bool", data=True)},
    "mode": {"by": message("std_msgs/Bool")},
    "diagnostics": {"by": message("diagnostic_msgs/DiagnosticArray", status=[{"name": "motor"}])},
    "overspeed": {"by": ODOMETRY},
    "standstill": {"by": ODOMETRY},
    "zone": {"by": SCAN, "mute": message("std_msgs/Bool")},
}  # fmt: skip
"""For each preset with a safe velocity that observes topics: messages after which the base may move."""
VALUES = {"zone": {"clear": "0"}, "ready": {"needFix": "true", "needCheck": "true"}}
SPEAKERS = {"diagnostics": ("by",), "hold_to_run": ("by",), "mode": ("by",)}
"""Topics on which each node has a say, so that the guard holds its topics until each has spoken again."""
BEFORE = {"hold_to_run": {"by": message("std_msgs/Bool")}}
"""Messages that come once before these."""
SEND_NOTHING = {
    "answer": "its goals are cancelled at their deadlines",
    "withhold": "it withholds until a message",
    "joints": "its safe message is a trajectory",
}
MADE = pytest.mark.parametrize("made", [interpreted, on_its_module], ids=["interpreter", "module"])
MADE_AT_NIGHT = pytest.mark.parametrize(
    "made",
    [pytest.param(interpreted, marks=pytest.mark.nightly), on_its_module],
    ids=["interpreter", "module"],
)
"""At the gate only as a relay runs a guard: `rosmop/tests/test_fast_path.py` compares both."""
DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "half": lambda data: data[: len(data) // 2],
    "cut": lambda data: data[:-1],
    "trailing": lambda data: data + b"\0",
    "other": lambda data: bytes(len(data) + 40),
}


Made = Callable[[SetPart], MonitorSet]


def started(name: str, made: Made, **values: str) -> MonitorSet:
    text = text_of(Guard(name, PRESETS[name], values=values or VALUES.get(name, {})))
    monitors = made(part_of(text))
    monitors.start(0)
    return monitors


def named(name: str, made: Made, **values: str) -> MonitorSet:
    """Return monitors that know their senders' names."""
    monitors = started(name, made, **values)
    monitors.name_senders(lambda source: ("10.0.0.1", NODES[source]))
    return monitors


def restarted(monitors: MonitorSet, following: MonitorSet, now: int) -> MonitorSet:
    groups = [(one.names, one.layout, one.base(), one.cells() or None) for one in monitors.kept_groups()]
    following.recover(groups, {}, now, restarted=True)
    return following


@pytest.mark.complete
def test_the_table_has_each_topic_that_a_preset_observes() -> None:
    observed = {
        f"{name}, {topic}"
        for name, preset in PRESETS.items()
        if name not in SEND_NOTHING
        for topic in set(preset.given_topics) - {"command", "cancel"}
    }
    where = "GOOD here, or the preset to SEND_NOTHING with the reason"
    require_rows(observed, (f"{name}, {topic}" for name, given in GOOD.items() for topic in given), where)


@MADE_AT_NIGHT
@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize(
    ("name", "damaged"), [(name, topic) for name, given in GOOD.items() for topic in given]
)
def test_a_moving_base_is_stopped_by_an_unreadable_observation(
    name: str, damaged: str, damage: str, made: Made
) -> None:
    monitors, topics, now = started(name, made), PRESETS[name].given_topics, SECOND
    for topic, data in BEFORE.get(name, {}).items():
        monitors.judge(topics[topic], bytearray(data), now)
    for _ in range(8):
        for topic, data in GOOD[name].items():
            now += SECOND // 100
            monitors.judge(topics[topic], bytearray(data), now)
    monitors.judge("/cmd_vel", bytearray(STILL), now)
    assert monitors.judge("/cmd_vel", bytearray(DRIVE), now).result == "passed"
    outcome = monitors.judge(topics[damaged], bytearray(DAMAGE[damage](GOOD[name][damaged])), now + 1)
    assert [fault.malformed for fault in outcome.faults] == [True]
    sent = [one.data for each in monitors.advance(now + 2) for one in each.sent_messages()]
    assert sent == [bytes(48)]
    driven = monitors.judge("/cmd_vel", bytearray(DRIVE), now + 3)
    assert driven.result == ("dropped" if name == "estop" or damaged in SPEAKERS.get(name, ()) else "changed")
    assert bytes(driven.buffer) != DRIVE or driven.result == "dropped"
    for topic, data in GOOD[name].items():
        if topic != damaged:
            assert monitors.judge(topics[topic], bytearray(data), now + 4).result == "passed"
    monitors.judge("/cmd_vel", bytearray(DRIVE), now + 5)
    if name == "estop":
        assert monitors.judge("/cmd_vel", bytearray(STILL), now + 6).result == "passed"
        monitors.resume("estop")
        monitors.judge("/cmd_vel", bytearray(STILL), now + 7)
        assert monitors.judge("/cmd_vel", bytearray(DRIVE), now + 8).result == "passed"


BEGIN = [
    (name, topic) for name, given in GOOD.items() if PRESETS[name].text.count("\nbegin ") for topic in given
]
NODES = ("", "/sensor", "/other", "/third")


def told(monitors: MonitorSet, name: str, now: int, nodes: Mapping[str, int], broken: str = "") -> str:
    """Give a message on each topic from these nodes (`""`: all other topics), and return what becomes of a motion."""
    for topic, data in GOOD[name].items():
        node = nodes.get(topic, nodes.get("", 0))
        if node:
            raw = bytearray(b"" if topic == broken else data)
            monitors.judge(PRESETS[name].given_topics[topic], raw, now, MessageSender(node))
    monitors.judge("/cmd_vel", bytearray(STILL), now, MessageSender(3))
    return monitors.judge("/cmd_vel", bytearray(DRIVE), now, MessageSender(3)).result


@MADE_AT_NIGHT
@pytest.mark.parametrize("kept", [False, True], ids=["running", "restarted"])
@pytest.mark.parametrize(("name", "damaged"), BEGIN)
def test_no_other_node_takes_the_place_of_one_whose_bytes_are_unreadable(
    name: str, damaged: str, kept: bool, made: Made
) -> None:
    monitors, now = named(name, made), SECOND
    for topic, data in BEFORE.get(name, {}).items():
        monitors.judge(PRESETS[name].given_topics[topic], bytearray(data), now, MessageSender(1))
    results = [told(monitors, name, now := now + SECOND // 100, {"": 1}) for _ in range(8)]
    assert results[-1] == "passed"
    told(monitors, name, now := now + SECOND // 100, {"": 1}, damaged)
    if kept:
        monitors = restarted(monitors, named(name, made), now)
    for switched in (False, True):
        if switched:
            for enabled in (False, True):
                monitors.switch({name: enabled}, now)
        for _ in range(30):
            now += SECOND // 20
            for topic, data in BEFORE.get(name, {}).items():
                monitors.judge(PRESETS[name].given_topics[topic], bytearray(data), now, MessageSender(2))
            result = told(monitors, name, now, {"": 1, damaged: 2})
            wanted = "dropped" if damaged in SPEAKERS.get(name, ()) else "changed"
            assert result == wanted or (name, damaged) == ("zone", "mute")
    for topic, data in BEFORE.get(name, {}).items():
        monitors.judge(PRESETS[name].given_topics[topic], bytearray(data), now, MessageSender(1))
    results = [told(monitors, name, now := now + SECOND // 100, {"": 1}) for _ in range(12)]
    assert results[-1] == "passed"


def test_a_node_that_is_not_the_first_keeps_the_guard_in_doubt_and_never_takes_its_place() -> None:
    source = Origin()
    assert source.hears("/a") and source.read("/a") and source.hears("/b")
    source.doubt("/b")
    assert not source.hears("/a") and not source.hears("/c")
    assert source.hears("/b") and not source.read("/b")
    assert not source.hears("/b") and source.hears("/a") and source.read("/a") and source.hears("/c")
    for number in range(20):
        source.doubt(f"/{number}")
    assert len(source.unreadable) == MAX + 1
    assert not any(map(source.read, [f"/{number}" for number in range(20)])) and not source.hears("/a")


def test_speakers_are_all_heard_and_all_awaited() -> None:
    source = Origin(speakers=True)
    assert all(source.hears(node) and source.read(node) for node in ("/a", "/b"))
    assert source.awaited == []
    source.doubt("/b")
    source.begin_again()
    assert source.awaited == ["/a", "/b"]
    assert source.hears("/c") and source.read("/c") and source.read("/b") and source.awaited == ["/a"]
    assert source.read("/a") and source.awaited == []
    for number in range(20):
        source.read(f"/{number}")
    source.begin_again()
    assert len(source.unreadable) == MAX + 1
    assert all(map(source.read, [f"/{number}" for number in range(20)])) and source.blocks
    source.forget()
    assert source.awaited == [] and source.hears("/z")


@MADE
@pytest.mark.parametrize("how", ["unreadable", "enabled again", "restarted"])
@pytest.mark.parametrize(
    ("name", "permits", "forbids"), [("hold_to_run", b"\1", b"\0"), ("mode", b"\0", b"\1")]
)
def test_the_word_of_a_node_is_not_forgotten_when_the_guard_begins_again(
    name: str, permits: bytes, forbids: bytes, how: str, made: Made
) -> None:
    """One of two nodes forbids the motion, and says nothing more; the guard must not go on with the other alone."""
    values = {"silent": "0"} if name == "mode" else {}
    monitors, now, topic = named(name, made, **values), SECOND, PRESETS[name].given_topics["by"]

    def moves(node: int, said: bytes) -> bool:
        nonlocal now
        now += SECOND // 100
        monitors.judge(topic, bytearray(said), now, MessageSender(node))
        monitors.judge("/cmd_vel", bytearray(STILL), now, MessageSender(3))
        return monitors.judge("/cmd_vel", bytearray(DRIVE), now, MessageSender(3)).result == "passed"

    for said in (b"\0", permits):
        for node in (1, 2):
            moving = moves(node, said)
    assert moving and not moves(2, forbids)
    if how == "enabled again":
        monitors.switch({name: False}, now)
        monitors.switch({name: True}, now)
    else:
        monitors.judge(topic, bytearray(b"\0\0"), now, MessageSender(1))
    if how == "restarted":
        monitors = restarted(monitors, named(name, made, **values), now)
    assert not any(moves(1, said) for said in (b"\0", permits) * 10)
    assert monitors.monitor(name).awaits == f"/other on {topic}"
    monitors.resume(name)
    assert any(moves(1, said) for said in (b"\0", permits))


@MADE
def test_the_topic_is_withheld_until_each_known_switch_has_spoken(made: Made) -> None:
    monitors = named("withhold", made)
    for node in (1, 2):
        monitors.judge("/privacy", bytearray(b"\0"), node, MessageSender(node))
    assert monitors.withheld_from("/camera/image_raw") == ()
    monitors.judge("/privacy", bytearray(b""), 3, MessageSender(1))
    for node, withheld in ((1, True), (2, False)):
        monitors.judge("/privacy", bytearray(b"\0"), 3 + node, MessageSender(node))
        assert bool(monitors.withheld_from("/camera/image_raw")) == withheld


@MADE
def test_a_person_lets_a_guard_hear_a_sensor_with_another_name(made: Made) -> None:
    monitors, now = named("sensor", made), SECOND
    for _ in range(4):
        result = told(monitors, "sensor", now := now + SECOND // 100, {"": 1})
    assert result == "passed"
    told(monitors, "sensor", now := now + SECOND // 100, {"": 1}, "by")
    for _ in range(200):
        result = told(monitors, "sensor", now := now + SECOND // 100, {"": 2})
    assert result == "changed" and monitors.monitor("sensor").awaits == "/sensor on /scan"
    monitors.hold(monitors.monitor("sensor"), "an operator asks for it")
    monitors.resume("sensor")  # ends the hold, and changes no source
    assert monitors.monitor("sensor").awaits == "/sensor on /scan"
    monitors.resume("sensor")
    assert not monitors.monitor("sensor").awaits
    for _ in range(4):
        result = told(monitors, "sensor", now := now + SECOND // 100, {"": 2})
    assert result == "passed"


def test_a_goal_is_cancelled_in_time_despite_an_unreadable_result() -> None:
    """The message belongs to no goal, so it ends none."""
    monitors = started("answer", interpreted)
    goal = bytearray(bytes(DEFINITIONS.layout("move_base_msgs/MoveBaseActionGoal").minimum))
    head = bytes(16)  # header, and the stamp of the goal's id
    goal = bytearray(head[:16] + bytes(8) + b"\1\0\0\0a" + goal[28:])
    assert monitors.judge("/move_base/goal", goal, SECOND).result == "passed"
    outcome = monitors.judge("/move_base/result", bytearray(b"\1"), 2 * SECOND)
    assert [fault.malformed for fault in outcome.faults] == [True]
    sent = [one.topic for each in monitors.advance(200 * SECOND) for one in each.sent_messages()]
    assert sent == ["/move_base/cancel"]


@MADE
def test_an_unreadable_joint_state_ends_the_trajectory(made: Made) -> None:
    monitors = started("joints", made)
    outcome = monitors.judge("/joint_states", bytearray(b"\1"), SECOND)
    assert [fault.malformed for fault in outcome.faults] == [True]
    sent = [one.topic for each in monitors.advance(SECOND + 1) for one in each.sent_messages()]
    assert sent == [PRESETS["joints"].given_topics["command"]]


@MADE
def test_the_topic_is_withheld_after_an_unreadable_switch(made: Made) -> None:
    monitors = started("withhold", made)
    monitors.judge("/privacy", bytearray(b"\0"), 1)
    assert monitors.withheld_from("/camera/image_raw") == ()
    monitors.judge("/privacy", bytearray(b"\0\0"), 2)
    assert monitors.withheld_from("/camera/image_raw") == ("0.0.0.0/0", "::/0")


@MADE
@pytest.mark.parametrize("part", ["request", "response"])
@pytest.mark.parametrize("damage", ["cut", "trailing"])
def test_an_unreadable_observation_of_a_service(part: str, damage: str, made: Made) -> None:
    field, data = ("data", b"\1") if part == "request" else ("success", b"\1\0\0\0\0")
    text = f"""guard() {{ safe geometry_msgs/Twist {{ }} on /cmd_vel every 100ms; bool off = false;
        event arm(bool on) service /arm std_srvs/SetBool {part} '{{{field}:on}}' {{ off = !on; }}
        event drive() /cmd_vel geometry_msgs/Twist '{{}}' {{ if (off) {{ STOP; }} }} }}"""
    monitors = made(part_of(text))
    monitors.start(0)
    channel = monitors.channel_of("/arm", part)
    assert monitors.judge(channel, bytearray(data), 1).result == "passed"
    assert monitors.judge("/cmd_vel", bytearray(DRIVE), 2).result == "passed"
    outcome = monitors.judge(channel, bytearray(DAMAGE[damage](data)), 3)
    assert (outcome.result, outcome.began_holding) == ("dropped", ("guard",))
    assert monitors.judge("/cmd_vel", bytearray(DRIVE), 4).result == "dropped"
    assert monitors.judge(channel, bytearray(data), 5).result == "passed"
