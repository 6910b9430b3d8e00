import math
import struct

import pytest

from appliance.cli.standing import STILL_SECONDS, StandingJudge, speed_in, unseen
from appliance.rpc.master_reader import PUBLICATION, SUBSCRIPTION, MasterGraph

CMD, ODOM = "/cmd_vel", "/odom"


def judged(*heard: tuple[float, str, float], odometry: tuple[str, ...] = (ODOM,), now: float = 10.0) -> str:
    judge = StandingJudge(frozenset({CMD}), frozenset(odometry))
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
    assert "no topic commands a base" in StandingJudge(frozenset(), frozenset()).why_not(STILL_SECONDS)


def test_the_speed_is_the_largest_component_of_the_twist() -> None:
    assert speed_in("geometry_msgs/Twist", (), struct.pack("<6d", 0, -2, 1, 0, 0, 0.5)) == 2.0
    assert speed_in("geometry_msgs/Twist", (), struct.pack("<6d", *[0.0] * 6)) == 0.0
    assert speed_in("geometry_msgs/Twist", (), b"\0" * 20) == math.inf, "a short message moves"
    assert speed_in("geometry_msgs/Twist", (), struct.pack("<6d", math.nan, 0, 0, 0, 0, 0)) == math.inf
    header = struct.pack("<IIII", 1, 2, 3, 0)
    assert (
        speed_in("geometry_msgs/TwistStamped", ("twist",), header + struct.pack("<6d", 1, 0, 0, 0, 0, 0))
        == 1.0
    )
    pose = struct.pack("<7d36d", *[0.0] * 43)
    odometry = header + struct.pack("<I", 0) + pose + struct.pack("<6d36d", 0.3, *[0.0] * 41)
    assert speed_in("nav_msgs/Odometry", ("twist", "twist"), odometry) == pytest.approx(0.3)


def test_the_answer_names_what_no_topic_says() -> None:
    types = {
        "/arm/command": "trajectory_msgs/JointTrajectory",
        CMD: "geometry_msgs/Twist",
        ODOM: "nav_msgs/Odometry",
    }
    base = frozenset({(SUBSCRIPTION, CMD, "/base"), (PUBLICATION, ODOM, "/base")})
    assert unseen(MasterGraph(base, types)) == "motions that no topic commands"
    arm = frozenset({(SUBSCRIPTION, "/arm/command", "/arm"), (SUBSCRIPTION, ODOM, "/map")})
    assert unseen(MasterGraph(arm, types)) == (
        "the real speed, because no node publishes odometry; what /arm/command may move; motions that no topic commands"
    )
