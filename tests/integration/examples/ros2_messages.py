"""Convert a filled message of each type to ROS 1 and back, and print which changed: ros2_messages.py FOLDER."""

import itertools
import json
import sys

sys.path.insert(0, sys.argv[1])
from messages import class_of, to_ros1, to_ros2

TYPES = (
    "std_msgs/String", "std_msgs/Bool", "std_msgs/Int32", "std_msgs/Float64", "std_msgs/Header",
    "std_msgs/ColorRGBA", "std_msgs/Float32MultiArray", "std_msgs/UInt8MultiArray", "geometry_msgs/Twist",
    "geometry_msgs/TwistStamped", "geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped",
    "geometry_msgs/Polygon", "nav_msgs/Odometry", "nav_msgs/Path", "nav_msgs/OccupancyGrid",
    "sensor_msgs/LaserScan", "sensor_msgs/Imu", "sensor_msgs/JointState", "sensor_msgs/CameraInfo",
    "sensor_msgs/Image", "sensor_msgs/NavSatFix", "sensor_msgs/Joy", "sensor_msgs/PointCloud2", "sensor_msgs/Range",
)  # fmt: skip
_numbers = itertools.count()


def value_of(kind: str, default: object) -> object:
    if "/" in kind:
        return filled(default)
    if kind in ("float", "double"):
        return next(_numbers) % 9 / 4
    if kind in ("uint8", "octet"):
        return next(_numbers) % 256
    return {"string": "word é", "boolean": True}.get(kind, next(_numbers) % 101)


def filled(message: object) -> object:
    for name, kind in message.get_fields_and_field_types().items():
        default = getattr(message, name)
        if kind.startswith("sequence<") or "[" in kind:
            inner = kind.removeprefix("sequence<").partition(">")[0].partition("[")[0]
            number = 3 if kind.startswith("sequence<") else len(default)
            made = class_of(inner) if "/" in inner else None
            setattr(message, name, [value_of(inner, made and made()) for _ in range(number)])
        else:
            setattr(message, name, value_of(kind, default))
    return message


for kind in TYPES:
    message = filled(class_of(kind)())
    again = to_ros2(json.loads(json.dumps(to_ros1(message))), class_of(kind)())
    sys.stdout.write(f"{kind} {'equal' if again == message else f'differs: {message} {again}'}\n")
