"""The definitions that ROS Noetic ships.

Messages come from the type store of `rosbags`. It lacks services, the messages of actions, and the message of `/tf`;
this module and `mavros` add the common ones.
"""

from itertools import islice

from roswire.definitions import Definitions
from roswire.mavros import MAVROS

_ADDITIONAL = {
    "std_srvs/Empty.srv": "---\n",
    "std_srvs/SetBool.srv": "bool data\n---\nbool success\nstring message\n",
    "std_srvs/Trigger.srv": "---\nbool success\nstring message\n",
    "roscpp/Empty.srv": "---\n",
    "roscpp/GetLoggers.srv": "---\nLogger[] loggers\n",
    "roscpp/SetLoggerLevel.srv": "string logger\nstring level\n---\n",
    "nav_msgs/GetMap.srv": "---\nOccupancyGrid map\n",
    "nav_msgs/GetPlan.srv": (
        "geometry_msgs/PoseStamped start\ngeometry_msgs/PoseStamped goal\nfloat32 tolerance\n---\nPath plan\n"
    ),
    "nav_msgs/SetMap.srv": (
        "OccupancyGrid map\ngeometry_msgs/PoseWithCovarianceStamped initial_pose\n---\nbool success\n"
    ),
    "nav_msgs/LoadMap.srv": (
        "string map_url\n---\n"
        "uint8 RESULT_SUCCESS=0\n"
        "uint8 RESULT_MAP_DOES_NOT_EXIST=1\n"
        "uint8 RESULT_INVALID_MAP_DATA=2\n"
        "uint8 RESULT_INVALID_MAP_METADATA=3\n"
        "uint8 RESULT_UNDEFINED_FAILURE=255\n"
        "OccupancyGrid map\nuint8 result\n"
    ),
    "sensor_msgs/SetCameraInfo.srv": "CameraInfo camera_info\n---\nbool success\nstring status_message\n",
    "tf/tfMessage.msg": "geometry_msgs/TransformStamped[] transforms\n",
    "tf2_msgs/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n",
    "ackermann_msgs/AckermannDrive.msg": (
        "float32 steering_angle\nfloat32 steering_angle_velocity\n"
        "float32 speed\nfloat32 acceleration\nfloat32 jerk\n"
    ),
    "ackermann_msgs/AckermannDriveStamped.msg": "Header header\nAckermannDrive drive\n",
    "move_base_msgs/RecoveryStatus.msg": (
        "geometry_msgs/PoseStamped pose_stamped\nuint16 current_recovery_number\n"
        "uint16 total_number_of_recoveries\nstring recovery_behavior_name\n"
    ),
    "control_msgs/GripperCommand.msg": "float64 position\nfloat64 max_effort\n",
    "control_msgs/JointTolerance.msg": (
        "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n"
    ),
}
_GRIPPER = "float64 position\nfloat64 effort\nbool stalled\nbool reached_goal\n"
_FOLLOWED = "Header header\nstring[] joint_names\n" + "".join(
    f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in ("desired", "actual", "error")
)
_FOLLOW_CODES = ("SUCCESSFUL", "INVALID_GOAL", "INVALID_JOINTS", "OLD_HEADER_TIMESTAMP",
                 "PATH_TOLERANCE_VIOLATED", "GOAL_TOLERANCE_VIOLATED")  # fmt: skip
_ACTIONS = {
    "move_base_msgs/MoveBase": (
        "geometry_msgs/PoseStamped target_pose\n",
        "",
        "geometry_msgs/PoseStamped base_position\n",
    ),
    "control_msgs/FollowJointTrajectory": (
        "trajectory_msgs/JointTrajectory trajectory\nJointTolerance[] path_tolerance\n"
        "JointTolerance[] goal_tolerance\nduration goal_time_tolerance\n",
        "int32 error_code\n"
        + "".join(f"int32 {name}={-number}\n" for number, name in enumerate(_FOLLOW_CODES))
        + "string error_string\n",
        _FOLLOWED,
    ),
    "control_msgs/GripperCommand": ("GripperCommand command\n", _GRIPPER, _GRIPPER),
}
"""Goal, result and feedback of each action, from which its messages are generated as by actionlib."""

_CONSTANTS_BEFORE = {
    "actionlib_msgs/GoalStatus": {"text": 10},
    "sensor_msgs/NavSatFix": {"position_covariance_type": 4},
    "sensor_msgs/NavSatStatus": {"status": 4, "service": 4},
    "sensor_msgs/Range": {"radiation_type": 2},
    "shape_msgs/SolidPrimitive": {"type": 4},
    "visualization_msgs/InteractiveMarkerControl": {"orientation_mode": 3, "interaction_mode": 10},
    "visualization_msgs/MenuEntry": {"command_type": 3},
}
"""The number of constants directly before a field, in types whose file does not begin with all constants.

The type store loses this order, and viewers would report that the definition differs from theirs.
"""

_NOT_ROS_1 = "builtin_interfaces"  # has `time` and `duration` as ROS 2 messages


def standard_definitions() -> Definitions:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415  most verbs need no definitions

    store = get_typestore(Stores.ROS1_NOETIC)
    files = _ADDITIONAL | MAVROS | _messages_of_actions()
    for name in store.fielddefs:
        package, _, type_name = name.split("/")
        if package != _NOT_ROS_1:
            before = _CONSTANTS_BEFORE.get(f"{package}/{type_name}")
            text = store.gendefhash(name, {})[0]
            files[f"{package}/{type_name}.msg"] = text if before is None else _in_places(text, before)
    return Definitions.from_files(files)


def _in_places(text: str, before: dict[str, int]) -> str:
    constants = iter([line for line in text.splitlines() if "=" in line])
    lines = []
    for line in [line for line in text.splitlines() if line and "=" not in line]:
        lines += [*islice(constants, before.get(line.split()[-1], 0)), line]
    return "\n".join([*lines, *constants, ""])


def _messages_of_actions() -> dict[str, str]:
    files = {}
    for name, parts in _ACTIONS.items():
        short = name.partition("/")[2]
        whole = ""
        for kind, text in zip(("Goal", "Result", "Feedback"), parts, strict=True):
            files[f"{name}{kind}.msg"] = text
            stamp = "GoalID goal_id" if kind == "Goal" else "GoalStatus status"
            files[f"{name}Action{kind}.msg"] = (
                f"Header header\nactionlib_msgs/{stamp}\n{short}{kind} {kind.lower()}\n"
            )
            whole += f"{short}Action{kind} action_{kind.lower()}\n"
        files[f"{name}Action.msg"] = whole
    return files
