from typing import Any

import pytest

from roswire.definitions import Definitions


@pytest.mark.nightly
def test_md5sums_are_those_of_the_installed_packages(
    standard: Definitions, genpy_types: dict[str, dict[str, Any]]
) -> None:
    for name, entry in genpy_types.items():
        md5sum = standard.service_md5sum if entry["kind"] == "service" else standard.md5sum
        assert md5sum(name) == entry["md5sum"], name


def test_every_type_is_whole(standard: Definitions) -> None:
    for name in standard.message_types:
        assert len(standard.md5sum(name)) == 32
        text = standard.full_text(name)
        assert Definitions.from_full_text(name, text).layout(name) == standard.layout(name)
    for name in standard.service_types:
        assert len(standard.service_md5sum(name)) == 32


def test_constants_keep_their_places(standard: Definitions) -> None:
    """Lichtblick reports a changed definition if the order of constants differs from ROS's file."""
    name = "sensor_msgs/NavSatStatus"
    lines = [line.rpartition(" ")[2].partition("=")[0] for line in standard.message(name).text.splitlines()]
    assert lines[4:] == [
        "status", "SERVICE_GPS", "SERVICE_GLONASS", "SERVICE_COMPASS", "SERVICE_GALILEO", "service"
    ]  # fmt: skip
    assert standard.md5sum(name) == "331cdbddfa4bc96ffc3b9ad98900a54c"
    assert standard.message("shape_msgs/SolidPrimitive").text.endswith("uint8 CONE_RADIUS=1\n")


def test_types_beside_the_type_store(standard: Definitions) -> None:
    messages = {
        "tf2_msgs/TFMessage": "94810edda583a504dfda3829e70d7eec",
        "tf/tfMessage": "94810edda583a504dfda3829e70d7eec",
        "move_base_msgs/MoveBaseAction": "70b6aca7c7f7746d8d1609ad94c80bb8",
        "move_base_msgs/MoveBaseActionGoal": "660d6895a1b9a16dce51fbdd9a64a56b",
        "control_msgs/FollowJointTrajectoryAction": "bc4f9b743838566551c0390c65f1a248",
        "control_msgs/GripperCommandGoal": "86fd82f4ddc48a4cb6856cfa69217e43",
        "control_msgs/GripperCommandResult": "e4cbff56d3562bcf113da5a5adeef91f",
        "ackermann_msgs/AckermannDriveStamped": "1fd5d7f58889cefd44d29f6653240d0c",
        "geographic_msgs/GeoPoint": "c48027a852aeff972be80478ff38e81a",
        "mavros_msgs/Altitude": "1296a05dc5b6160be0ae04ba9ed3a3fa",
        "mavros_msgs/AttitudeTarget": "456f3af666b22ccd0222ea053a86b548",
        "mavros_msgs/ExtendedState": "ae780b1800fe17b917369d21b90058bd",
        "mavros_msgs/GlobalPositionTarget": "076ded0190b9e045f9c55264659ef102",
        "mavros_msgs/HomePosition": "c1167922de8c97acdb0ec714c1dba774",
        "mavros_msgs/OverrideRCIn": "fd1e1c08fa504ec32737c41f45223398",
        "mavros_msgs/PositionTarget": "dedb0081aaf8cb20209737746bb49117",
        "mavros_msgs/RCIn": "1c3eafdb5efbcda3c334e1788bbcfe39",
        "mavros_msgs/RCOut": "52cacf104bab5ae3b103cfe176590713",
        "mavros_msgs/State": "65cd0a9fff993b062b91e354554ec7e9",
        "mavros_msgs/StatusText": "6cfd33cd09e4abf5841d7be3c770a969",
        "mavros_msgs/Thrust": "c61da3a8868a8b502eaf0b0abd839f57",
        "mavros_msgs/VFR_HUD": "1f55e210c3d39fe105d44d8dc963655f",
        "mavros_msgs/Waypoint": "f7090ce9f0c7ad0665de1ddadfd11ace",
        "mavros_msgs/WaypointList": "0605a2df153acd9a4a4823385ed81b57",
        "mavros_msgs/WaypointReached": "1cf64d072d9f6aa0a6715922bdde6a35",
    }
    services = {
        "mavros_msgs/CommandBool": "e09abbb4e5bae6b558e5010966eb6e9e",
        "mavros_msgs/CommandLong": "eb9034afc87577c0a235d45b8f3437d2",
        "mavros_msgs/CommandTOL": "93ff4eaa9907f58c0e7a909cddce23e2",
        "mavros_msgs/SetMode": "e4f18fa93379f9ff1780d270ce110203",
    }
    assert {name: standard.md5sum(name) for name in messages} == messages
    assert {name: standard.service_md5sum(name) for name in services} == services
