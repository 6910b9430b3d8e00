import math
import struct

import pytest

from appliance.cli.robot_motions import (
    STILL_SECONDS,
    MotionTopics,
    StandingJudge,
    motion_topics,
    speed_in,
    unseen,
)
from appliance.rpc.master_reader import PUBLICATION, SUBSCRIPTION, MasterGraph

CMD, ODOM = "/cmd_vel", "/odom"


def judged(*heard: tuple[float, str, float], odometry: tuple[str, ...] = (ODOM,), now: float = 10.0) -> str:
    judge = StandingJudge(MotionTopics({CMD: frozenset(odometry)}, frozenset(odometry)))
    for when, topic, speed in heard:
        judge.hear(topic, speed, when)
    return judge.why_not(now)


def zeros(topic: str, begin: float, end: float = 10.0) -> list[tuple[float, str, float]]:
    return [(begin + 0.1 * step, topic, 0.0) for step in range(int((end - begin) / 0.1) + 1)]


def test_a_commanded_and_a_measured_zero_of_some_seconds_stand() -> None:
    assert judged(*zeros(CMD, 5.0), *zeros(ODOM, 5.0)) == ""
    assert judged((1.0, CMD, 0.0), *zeros(ODOM, 5.0)) == "", "a zero is valid until the next command"
    assert judged((1.0, CMD, 0.0), odometry=()) == "", "a robot without odometry"


@pytest.mark.parametrize(
    ("heard", "reason"),
    [
        ([], "no zero was commanded on /cmd_vel"),
        (zeros(ODOM, 1.0), "no zero was commanded on /cmd_vel"),
        ([(1.0, CMD, 0.0)], "/odom is silent"),
        ([(1.0, CMD, 0.0), *zeros(ODOM, 1.0, 5.0)], "/odom is silent"),
        ([(1.0, CMD, 0.0), (2.0, CMD, 0.4), *zeros(ODOM, 1.0)], "/cmd_vel says that it moves"),
        ([(1.0, CMD, 0.0), *zeros(ODOM, 1.0), (9.9, ODOM, 0.2)], "/odom says that it moves"),
        ([(1.0, CMD, 0.0), (9.0, ODOM, 0.2), (9.1, ODOM, 0.0)], "it stands for less than 3 s"),
        ([(1.0, CMD, 0.0), (9.0, CMD, math.inf)], "/cmd_vel says that it moves"),
        ([(1.0, CMD, 0.0), (9.0, CMD, math.nan)], "/cmd_vel says that it moves"),
    ],
)
def test_silence_motion_and_a_short_stop_do_not_stand(
    heard: list[tuple[float, str, float]], reason: str
) -> None:
    assert judged(*heard) == reason


def test_a_robot_without_commands_is_not_known_to_stand() -> None:
    assert "no topic commands a base" in StandingJudge(MotionTopics({}, frozenset())).why_not(STILL_SECONDS)


def test_the_speed_is_the_largest_component_of_the_twist() -> None:
    assert speed_in("geometry_msgs/Twist", struct.pack("<6d", 0, -2, 1, 0, 0, 0.5)) == 2.0
    assert speed_in("geometry_msgs/Twist", struct.pack("<6d", *[0.0] * 6)) == 0.0
    assert speed_in("geometry_msgs/Twist", b"\0" * 20) == math.inf, "a short message moves"
    assert speed_in("geometry_msgs/Twist", struct.pack("<6d", math.nan, 0, 0, 0, 0, 0)) == math.inf
    header = struct.pack("<IIII", 1, 2, 3, 0)
    assert speed_in("geometry_msgs/TwistStamped", header + struct.pack("<6d", 1, 0, 0, 0, 0, 0)) == 1.0
    pose = struct.pack("<7d36d", *[0.0] * 43)
    odometry = header + struct.pack("<I", 0) + pose + struct.pack("<6d36d", 0.3, *[0.0] * 41)
    assert speed_in("nav_msgs/Odometry", odometry) == pytest.approx(0.3)


def test_the_answer_names_what_no_topic_says() -> None:
    types = {
        "/arm/command": "trajectory_msgs/JointTrajectory",
        CMD: "geometry_msgs/Twist",
        ODOM: "nav_msgs/Odometry",
    }
    base = MasterGraph(frozenset({(SUBSCRIPTION, CMD, "/base"), (PUBLICATION, ODOM, "/base")}), types)
    assert unseen(base, motion_topics(base, {"/base"})) == "motions that no topic commands"
    arm = MasterGraph(
        frozenset({(SUBSCRIPTION, "/arm/command", "/arm"), (SUBSCRIPTION, ODOM, "/map")}), types
    )
    assert unseen(arm, motion_topics(arm, {"/arm", "/map"})) == (
        "the real speed, because no node publishes odometry; what /arm/command may move; motions that no topic commands"
    )


# --- each command topic of the robot is asked ---

TWIST = "geometry_msgs/Twist"
OWN = frozenset({"/base", "/arm_base", "/mux", "/nav", "/ekf", "/record_123"})


def graph_of(*rows: tuple[str, str, str], kinds: dict[str, str] | None = None) -> MasterGraph:
    """Return a graph of (topic, publisher, subscriber), of velocities unless `kinds` says otherwise."""
    ends = [
        (kind, topic, name)
        for topic, publisher, subscriber in rows
        for kind, name in ((PUBLICATION, publisher), (SUBSCRIPTION, subscriber))
        if name
    ]
    return MasterGraph(frozenset(ends), {topic: TWIST for topic, *_ends in rows} | (kinds or {}))


def verdict(topics: MotionTopics, *heard: tuple[float, str, float]) -> str:
    judge = StandingJudge(topics)
    for when, topic, speed in heard:
        judge.hear(topic, speed, when)
    return judge.why_not(10.0)


def test_a_zero_of_one_command_topic_says_nothing_of_another() -> None:
    topics = motion_topics(graph_of((CMD, "/nav", "/base"), ("/b/cmd_vel", "", "/arm_base")), OWN)
    assert topics.commands.keys() == {CMD, "/b/cmd_vel"}
    assert verdict(topics, *zeros(CMD, 1.0)) == "no zero was commanded on /b/cmd_vel"
    assert verdict(topics, *zeros(CMD, 1.0), (2.0, "/b/cmd_vel", 0.0)) == ""


def test_the_odometry_of_another_base_says_nothing_of_a_silent_one() -> None:
    rows = ((CMD, "/nav", "/base"), (ODOM, "/base", ""), ("/b/cmd_vel", "", "/arm_base"))
    topics = motion_topics(graph_of(*rows, kinds={ODOM: "nav_msgs/Odometry"}), OWN)
    assert topics.commands == {CMD: {ODOM}, "/b/cmd_vel": frozenset()}
    assert "no zero was commanded on /b/cmd_vel" in verdict(topics, *zeros(CMD, 1.0), *zeros(ODOM, 1.0))


def test_a_silent_topic_whose_driver_measures_zero_is_named_and_no_obstacle() -> None:
    rows = ((CMD, "/nav", "/base"), (ODOM, "/base", ""), ("/joy/cmd_vel", "", "/base"))
    graph = graph_of(*rows, kinds={ODOM: "nav_msgs/Odometry"})
    topics = motion_topics(graph, OWN)
    judge = StandingJudge(topics)
    for when, topic, speed in (*zeros(CMD, 1.0), *zeros(ODOM, 1.0)):
        judge.hear(topic, speed, when)
    assert judge.why_not(10.0) == ""
    assert (judge.commanded, judge.silent) == ([CMD], ["/joy/cmd_vel"])
    assert "a command on /joy/cmd_vel" in unseen(graph, topics, judge.silent)


def test_topics_of_a_guest_neither_prevent_nor_prove_that_the_robot_stands() -> None:
    guests = [(f"/guest{number}/cmd_vel", "/guest", "/guest_base") for number in range(17)]
    odometry = ("/guest_odom", "/guest", "")
    graph = graph_of((CMD, "/nav", "/base"), *guests, odometry, kinds={"/guest_odom": "nav_msgs/Odometry"})
    topics = motion_topics(graph, OWN)
    assert topics == MotionTopics({CMD: frozenset()}, frozenset(), tuple(sorted(one for one, *_ in guests)))
    assert "17" not in verdict(topics, *zeros(CMD, 1.0))
    assert "of other hosts may move" in unseen(graph, topics)
    alone = motion_topics(graph_of(*guests), OWN)
    assert verdict(alone, *zeros(guests[0][0], 1.0)).startswith("no topic commands a base of this robot")


def test_a_driver_of_another_computer_counts_if_the_robot_commands_it() -> None:
    assert motion_topics(graph_of((CMD, "/mux", "/nuc_base")), OWN).commands.keys() == {CMD}


def test_multiplexers_and_recorders_drive_nothing_and_drivers_that_measure_do() -> None:
    graph = graph_of(
        ("/nav/cmd_vel", "/nav", "/mux"), (CMD, "/mux", "/base"), ("/seen", "/guest", "/record_123"),
        ("/measured", "/base", "/ekf"),
    )  # fmt: skip
    assert motion_topics(graph, OWN).commands.keys() == {CMD, "/measured"}


@pytest.mark.parametrize("absent", ["", CMD, "/b/cmd_vel", ODOM, "/b/odom"])
def test_a_robot_stands_only_if_each_sign_was_seen(absent: str) -> None:
    """Each input of the verdict, absent once: a command topic may be silent only beside its own measured zero."""
    rows = (
        (CMD, "/nav", "/base"),
        (ODOM, "/base", ""),
        ("/b/cmd_vel", "", "/arm_base"),
        ("/b/odom", "/ekf", ""),
    )
    kinds = {ODOM: "nav_msgs/Odometry", "/b/odom": "nav_msgs/Odometry"}
    topics = motion_topics(graph_of(*rows, kinds=kinds), OWN)
    signs = [
        one for topic in (CMD, ODOM, "/b/cmd_vel", "/b/odom") if topic != absent for one in zeros(topic, 1.0)
    ]
    found = verdict(topics, *signs)
    assert (found == "") == (absent in {"", CMD})
    assert absent in {"", CMD} or absent in found
