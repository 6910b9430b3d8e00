"""ROS's own definitions: the same types as on the robot."""

from typing import Any

from appliance.ros.definitions import Definitions

NOT_SHIPPED = {"move_base_msgs"}  # on this machine for the tests; its types come from connection headers


def test_md5sums_are_those_of_the_installed_packages(
    standard: Definitions, genpy_types: dict[str, dict[str, Any]]
) -> None:
    """Every message and service type of ROS's own packages is there, with the md5sum that nodes compare."""
    for name, entry in genpy_types.items():
        if name.split("/")[0] in NOT_SHIPPED:
            continue
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
