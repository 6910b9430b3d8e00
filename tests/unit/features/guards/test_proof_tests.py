"""`rosrv guard test`: each preset, by its own stimulus, on a copy that leaves the guard in force as it is."""

import contextlib
import itertools
import math
import re
import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import AsyncMock

import pytest

from appliance.base.withdrawal import WITHDRAWN, WithdrawnError, withdrawable
from appliance.channel.answers.graph_answers import Graph, Node, Topic
from appliance.channel.messages import GuardTested, GuardTestWanted, MessageSeen, SubscriberReached
from appliance.control.errors import SenselessError
from appliance.features.guards.presets import PRESETS, Guard, text_of, topics_in, types_in, values_in
from appliance.features.guards.proof_tests import ProofTests, kept_tests
from appliance.features.guards.requests import GuardTest
from appliance.features.guards.stimuli import Stimulus, stimulus
from appliance.relay.monitors.guard_trial import GuardTrials
from tests.support.answers import example
from tests.support.core import FakeTrail
from tests.support.examples import ALL
from tests.support.rows import require_rows
from tests.unit.features.guards.guard_desk import monitors_of
from tests.unit.features.guards.test_guard_orders import Settings, orders_of
from tests.unit.relay.monitors.quiet import QuietMonitors

ACKERMANN = {"command": "ackermann_msgs/AckermannDriveStamped"}
STAMPED = {"command": "geometry_msgs/TwistStamped"}
GOAL = {"command": "control_msgs/FollowJointTrajectoryActionGoal"}
CASES: list[tuple[str, dict[str, str], dict[str, str], str]] = [
    ("deadman", {}, {}, "stopped"),
    ("deadman", ACKERMANN, {"silent": "0.05", "resume": "2"}, "stopped"),
    ("speed", {}, {}, "limited"),
    ("speed", STAMPED, {"aMax": "0.01"}, "limited"),
    ("separation", {}, {}, "stopped"),
    ("separation", ACKERMANN, {}, "stopped"),
    ("fence", {"by": "nav_msgs/Odometry"}, {"polygon": "0,0 4,0 4,1 1,1 1,4 0,4"}, "stopped"),
    ("fence", {"by": "sensor_msgs/NavSatFix"}, {"lat0": "48", "lon0": "11", "worldFrame": "true"}, "stopped"),
    ("fence", {"by": "geometry_msgs/PoseStamped"}, {}, "stopped"),
    ("sensor", {"by": "sensor_msgs/Imu"}, {}, "stopped"),
    ("sensor", {"by": "sensor_msgs/PointCloud2"}, {}, "stopped"),
    ("estop", {}, {"twoHands": "true", "publishers": "3"}, "stopped"),
    ("estop", {"command": "trajectory_msgs/JointTrajectory"}, {}, "stopped"),
    ("ready", {}, {"hundred": "true", "needFix": "true", "needCheck": "true"}, "stopped"),
    ("answer", {}, {}, "stopped"),
    ("joints", {}, {}, "stopped"),
    ("joints", GOAL, {"limits": "elbow:0.5..1.5 wrist:-1..0"}, "dropped"),
    ("rate", {}, {}, "dropped"),
    ("rate", {}, {"interval": "1", "burst": "30"}, "dropped"),
    ("agree", {}, {"samples": "20"}, "stopped"),
    ("sane", {}, {}, "stopped"),
    ("hold_to_run", {}, {"publishers": "2"}, "stopped"),
    ("hold_to_run", {"by": "sensor_msgs/Joy"}, {"button": "3"}, "stopped"),
    ("mode", {}, {}, "stopped"),
    ("overspeed", {}, {}, "stopped"),
    ("standstill", {}, {}, "stopped"),
    ("zone", {}, {"clear": "2", "own": "0.3"}, "stopped"),
    ("zone", {}, {"slow": "0.2"}, "limited"),
    ("diagnostics", {}, {"named": "Battery, hokuyo_node: *, hardware_id:0815"}, "stopped"),
    ("withhold", {}, {}, "withheld"),
]
WITHOUT_ROLE = {"stop": "std_msgs/Bool", "reset": "std_msgs/Bool", "fix": "sensor_msgs/NavSatFix",
                "check": "std_msgs/Bool", "mute": "std_msgs/Bool"}  # fmt: skip


def made(preset: str, types: dict[str, str], values: dict[str, str]) -> str:
    return text_of(Guard("guard", PRESETS[preset], types=types, values=values))


def stimulus_of(text: str, preset: str) -> Stimulus:
    return stimulus(preset, topics_in(text), WITHOUT_ROLE | types_in(text), values_in(text))


def outcome_of(text: str, test: Stimulus, command: str) -> tuple[GuardTested, QuietMonitors]:
    quiet = QuietMonitors()
    quiet.load(text)
    trials = GuardTrials(quiet.loop, quiet.interceptor, lambda _topic, _data: (), quiet.reports.send)
    trials.order(GuardTestWanted(7, "guard", command, test.messages, test.fault, deliver=True))
    quiet.loop.finish()
    found: Any = quiet.reports.sent[-1]
    return found, quiet


RUN = CASES if ALL else list({case[0]: case for case in reversed(CASES)}.values())


@pytest.mark.complete
def test_each_preset_has_a_fault() -> None:
    require_rows(
        PRESETS, {case[0] for case in CASES}, "CASES, and `_FAULTS` of appliance/features/guards/stimuli.py"
    )


@pytest.mark.parametrize(
    ("preset", "types", "values", "act"), RUN, ids=[f"{n}-{one[0]}" for n, one in enumerate(RUN)]
)
def test_a_copy_passes_the_honest_motion_and_acts_at_the_fault(
    preset: str, types: dict[str, str], values: dict[str, str], act: str
) -> None:
    text = made(preset, types, values)
    test = stimulus_of(text, preset)
    found, _quiet = outcome_of(text, test, topics_in(text)["command"])
    assert (found.why, found.passed, found.act) == ("", True, act)
    if act == "stopped" and found.cause:  # as in the records: the line of the stop, and no other one
        assert f'"{found.cause}' not in text


def test_the_guard_in_force_gets_no_message_of_a_test_and_nothing_is_published() -> None:
    text = made("estop", {}, {"publishers": "1"})
    found, quiet = outcome_of(text, stimulus_of(text, "estop"), "/cmd_vel")
    monitors = quiet.interceptor.monitors
    assert monitors is not None
    assert (found.act, monitors.value("guard", "buttons"), quiet.published) == ("stopped", [], [])


def test_a_guard_that_no_longer_acts_fails_its_test() -> None:
    """A press that the text ignores is found; a copy that also stops the honest motion decides nothing."""
    text = made("estop", {}, {})
    declared = "event button(bool pressed) stop std_msgs/Bool '{data:pressed}' {"
    deaf = text.replace(declared, f"{declared} pressed = false;")
    assert deaf != text
    found, _quiet = outcome_of(deaf, stimulus_of(text, "estop"), "/cmd_vel")
    assert (found.passed, found.act) == (True, "")
    never = made("estop", {}, {"publishers": "8"})  # the honest robot of the test has one button
    found, _quiet = outcome_of(never, stimulus_of(text, "estop"), "/cmd_vel")
    assert found.passed is False


class Driver:
    """A subscriber whose connection is a real one to a peer in this thread."""

    def __init__(self, local: socket.socket) -> None:
        self.caller_id, self.host, self.descriptor = "/base", "10.0.0.5", local.fileno()


@pytest.mark.parametrize(("reads", "taken"), [(True, True), (False, True), (False, False)])
def test_a_stop_is_accepted_by_the_socket_and_acknowledged_by_tcp_apart(
    reads: bool, taken: bool, sockets: None
) -> None:
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        local = stack.enter_context(socket.create_connection(server.getsockname()))
        stack.enter_context(server.accept()[0])
        local.setblocking(False)
        if not reads:  # the peer's window is closed, so later bytes stay with the sender
            with contextlib.suppress(BlockingIOError):
                while True:
                    local.send(bytes(65536))
        driver: Any = Driver(local)
        if not taken:
            driver.descriptor = -1  # its queue has bytes that the socket has not taken
        text = made("sane", {}, {})
        quiet = QuietMonitors()
        quiet.load(text)
        sent: list[tuple[str, bytes]] = []

        def deliver(topic: str, data: bytes) -> list[Any]:
            sent.append((topic, data))
            return [driver]

        trials = GuardTrials(quiet.loop, quiet.interceptor, deliver, quiet.reports.send)
        test = stimulus_of(text, "sane")
        trials.order(GuardTestWanted(7, "guard", "/cmd_vel", test.messages, test.fault, deliver=True))
        quiet.loop.finish()
        while not isinstance(found := quiet.reports.sent[-1], GuardTested):
            quiet.loop.run_due()
        assert sent == [("/cmd_vel", bytes(48))]
        [one] = found.reached
        assert (one.accepted is not None, one.acknowledged is not None) == (taken, reads)


def test_a_test_of_a_control_that_has_ended_sends_no_stop_and_no_answer() -> None:
    text = made("sane", {}, {})
    quiet, sent = QuietMonitors(), list[str]()
    quiet.load(text)

    def deliver(topic: str, _data: bytes) -> list[Any]:
        sent.append(topic)
        return []

    trials = GuardTrials(quiet.loop, quiet.interceptor, deliver, quiet.reports.send)
    test, before = stimulus_of(text, "sane"), len(quiet.reports.sent)
    trials.order(GuardTestWanted(7, "guard", "/cmd_vel", test.messages, test.fault, deliver=True))
    trials.forget()
    quiet.loop.finish()
    assert (sent, len(quiet.reports.sent)) == ([], before)


ZERO = {"linear": {"x": 0.0, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}
MOVES = {**ZERO, "angular": {"x": 0.0, "y": 0.0, "z": 0.4}}
NAN = {**ZERO, "linear": {"x": math.nan, "y": 0.0, "z": 0.0}}


def odometry(twist: dict[str, Any]) -> dict[str, Any]:
    return {
        "header": {"seq": 7, "frame_id": "odom"},
        "child_frame_id": "base_link",
        "pose": {"pose": {"position": {"x": 3.0}}},
        "twist": {"twist": twist, "covariance": [1.0]},
    }


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("said", "refusal"),
    [
        ({"/cmd_vel": [ZERO], "/odom": [odometry(ZERO)]}, ""),
        ({"/cmd_vel": [ZERO]}, ""),
        ({"/odom": [odometry(ZERO)]}, ""),
        ({}, "no zero was commanded on /cmd_vel, and /odom was silent"),
        ({"/cmd_vel": [ZERO, MOVES]}, "/teleop drives on /cmd_vel"),
        ({"/cmd_vel": [NAN]}, "/teleop drives on /cmd_vel"),
        ({"/cmd_vel": [{}]}, "/teleop drives on /cmd_vel"),
        ({"/cmd_vel": [ZERO], "/odom": [odometry(ZERO), odometry(MOVES)]}, "/odom says that the base moves"),
        ({"/cmd_vel": [ZERO]}, WITHDRAWN),
    ],
)
async def test_only_a_robot_that_is_known_to_stand_is_tested(
    said: dict[str, list[Any]], refusal: str, tmp_path: Path
) -> None:
    """Without evidence, or with a message that cannot be read, the relay gets no order."""
    topics = [
        example(Topic, name="/cmd_vel", type="geometry_msgs/Twist", subscribers=["/base"],
                publishers=[{"node": "/teleop", "messages_per_second": 1.0}]),
        example(Topic, name="/odom", type="nav_msgs/Odometry", subscribers=[],
                publishers=[{"node": "/base", "messages_per_second": 1.0}]),
    ]  # fmt: skip
    tested: list[GuardTestWanted] = []

    async def look(
        topic: str, _count: int, _seconds: float, _who: str, *, latched: bool
    ) -> list[MessageSeen]:
        assert not latched
        return [MessageSeen(1, "k", 0, "", 48, fields) for fields in said.pop(topic, [])]

    async def test(wanted: GuardTestWanted) -> GuardTested:
        tested.append(wanted)
        reached = [SubscriberReached(node, "10.0.0.5", 0.001, 0.002) for node in ("/base", "/rviz")]
        return GuardTested(1, "", True, "stopped", 0.1, "why", 0.004, reached)

    graph: Any = SimpleNamespace(present=lambda: Graph([], topics, []), name_of=lambda _key: "/teleop")
    relay: Any = SimpleNamespace(look=look, test=test)
    store, trail = Settings(), FakeTrail()
    async with monitors_of(tmp_path) as monitors:
        orders = orders_of(monitors, trail)
        proofs = ProofTests(
            monitors, orders, {}, graph=graph, relay=relay, trail=trail, store=cast(Any, store)
        )
        if refusal:
            gone = refusal == WITHDRAWN  # its client left while the robot was watched
            refused = pytest.raises((SenselessError, WithdrawnError), match=re.escape(refusal))
            with withdrawable(lambda: gone), refused:
                await proofs.test(GuardTest("fence"), "eve")
            assert not tested
            return
        found = await proofs.test(GuardTest("fence"), "eve")
        assert [one.deliver for one in tested] == [True]
        assert [(one.node, one.driver) for one in found.reached] == [("/base", True), ("/rviz", False)]
        assert found.proved and found.digest == orders.row("fence").digest
        assert kept_tests(cast(Any, store)) == {"fence": found}
        assert trail.rows[-1]["event"] == "guard tested"


@pytest.mark.anyio
async def test_a_guard_is_proved_only_if_each_registered_driver_acknowledges(tmp_path: Path) -> None:
    drivers = ("/base", "/horn", "/lights")
    topics = [example(Topic, name="/cmd_vel", type="geometry_msgs/Twist", subscribers=[*drivers, "/rviz"],
                      publishers=[{"node": "/teleop", "messages_per_second": 1.0}])]  # fmt: skip
    nodes = [example(Node, name=node, host="10.0.0.5") for node in drivers]
    graph: Any = SimpleNamespace(present=lambda: Graph(nodes, topics, []), name_of=lambda _key: "/teleop")

    async with monitors_of(tmp_path) as monitors:
        for arrived in itertools.chain.from_iterable(itertools.combinations(drivers, n) for n in range(1, 4)):
            reached = [SubscriberReached(node, "10.0.0.5", 0.001, 0.002) for node in (*arrived, "/rviz")]
            found = GuardTested(1, "", True, "stopped", 0.1, "why", 0.004, reached)
            look = AsyncMock(side_effect=[[MessageSeen(1, "k", 0, "", 48, {**ZERO})], []])
            relay: Any = SimpleNamespace(look=look, test=AsyncMock(return_value=found))
            proofs = ProofTests(monitors, orders_of(monitors), {}, graph=graph, relay=relay, trail=FakeTrail(),
                                store=cast(Any, Settings()))  # fmt: skip
            test = await proofs.test(GuardTest("fence"), "eve")
            assert test.proved is (arrived == drivers)
            rows = [(one.node, one.host) for one in test.reached if one.driver]
            assert sorted(rows) == [(node, "10.0.0.5") for node in drivers]
