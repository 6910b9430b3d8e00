"""ROS's own definitions: the same types as on the robot."""

from typing import Any

from roswire.definitions import Definitions


def test_md5sums_are_those_of_the_installed_packages(
    standard: Definitions, genpy_types: dict[str, dict[str, Any]]
) -> None:
    """Every message and service type of ROS's own packages is there, with the md5sum that nodes compare."""
    for name, entry in genpy_types.items():
        md5sum = standard.service_md5sum if entry["kind"] == "service" else standard.md5sum
        assert md5sum(name) == entry["md5sum"], name


def test_every_type_is_whole(standard: Definitions) -> None:
    """Every type has a md5sum, a full text and a layout."""
    for name in standard.message_types:
        assert len(standard.md5sum(name)) == 32
        text = standard.full_text(name)
        assert Definitions.from_full_text(name, text).layout(name) == standard.layout(name)
    for name in standard.service_types:
        assert len(standard.service_md5sum(name)) == 32


def test_types_beside_the_type_store(standard: Definitions) -> None:
    """The message of /tf, which the tests' machine lacks, has the md5sum of ROS Noetic."""
    assert standard.md5sum("tf2_msgs/TFMessage") == "94810edda583a504dfda3829e70d7eec"
    assert standard.md5sum("tf/tfMessage") == "94810edda583a504dfda3829e70d7eec"


def test_actions_and_drive_commands_beside_the_type_store(standard: Definitions) -> None:
    """The messages of common actions are those that genaction makes: the md5sums of ROS Noetic."""
    known = {
        "move_base_msgs/MoveBaseAction": "70b6aca7c7f7746d8d1609ad94c80bb8",
        "move_base_msgs/MoveBaseActionGoal": "660d6895a1b9a16dce51fbdd9a64a56b",
        "control_msgs/FollowJointTrajectoryAction": "bc4f9b743838566551c0390c65f1a248",
        "control_msgs/GripperCommandGoal": "86fd82f4ddc48a4cb6856cfa69217e43",
        "control_msgs/GripperCommandResult": "e4cbff56d3562bcf113da5a5adeef91f",
        "ackermann_msgs/AckermannDriveStamped": "1fd5d7f58889cefd44d29f6653240d0c",
    }
    assert {name: standard.md5sum(name) for name in known} == known
