"""The definitions that ROS Noetic ships: messages from the type store of `rosbags`, and the common services.

The store has no services, and not the message of `/tf`; these few are written here.
"""

from rosbags.typesys import Stores, get_typestore

from appliance.ros.definitions import Definitions

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
}
_NOT_ROS_1 = "builtin_interfaces"  # the store keeps `time` and `duration` as messages of ROS 2


def standard_definitions() -> Definitions:
    """Return the definitions of ROS's own message packages and services."""
    store = get_typestore(Stores.ROS1_NOETIC)
    files = dict(_ADDITIONAL)
    for name in store.fielddefs:
        package, _, type_name = name.split("/")
        if package != _NOT_ROS_1:
            files[f"{package}/{type_name}.msg"] = store.gendefhash(name, {})[0]
    return Definitions.from_files(files)
