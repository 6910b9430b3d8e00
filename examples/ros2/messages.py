"""Convert messages of a door (rosbridge's JSON, ROS 1 fields) to messages of ROS 2, and back.

ROS 2 has no `seq` in headers, calls the parts of a time `sec` and `nanosec`, and writes all fields in lower case.
rosbridge sends arrays of bytes as base64, and a number that JSON lacks as null.
"""

import base64
import importlib
import math
from collections.abc import Mapping
from typing import Any

_PARTS_OF_TIME = {"sec": "secs", "nanosec": "nsecs"}
_UPPER = {"sensor_msgs/CameraInfo": ("D", "K", "R", "P")}
"""The fields that ROS 1 writes in upper case."""
_BYTES = ("sequence<uint8", "sequence<octet", "sequence<char")


def class_of(kind: str, part: str = "msg") -> Any:
    """Return the class of a type as ROS 1 writes it, such as `nav_msgs/Odometry`. Raises `ValueError`."""
    package, _, name = kind.partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.{part}"), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{kind} is not installed for ROS 2: {error}") from None


def to_ros2(values: Mapping[str, Any], message: Any) -> Any:
    """Fill a message of ROS 2 with the fields of a message of a door, and return it."""
    given = {name.lower(): value for name, value in values.items()}
    for name, kind in message.get_fields_and_field_types().items():
        value = given.get(name, given.get(_PARTS_OF_TIME.get(name, name)))
        if value is not None or kind.startswith(("float", "double")):
            setattr(message, name, _ros2_value(value, kind, getattr(message, name)))
    return message


def to_ros1(message: Any) -> dict[str, Any]:
    """Return the fields of a message of ROS 2 as a door takes them."""
    module = type(message).__module__.partition(".")[0]
    upper = {name.lower(): name for name in _UPPER.get(f"{module}/{type(message).__name__}", ())}
    is_time = module == "builtin_interfaces"
    fields = {}
    for name, kind in message.get_fields_and_field_types().items():
        name_in_ros1 = _PARTS_OF_TIME[name] if is_time else upper.get(name, name)
        fields[name_in_ros1] = _ros1_value(getattr(message, name), kind)
    return fields


def _ros2_value(value: Any, kind: str, default: Any) -> Any:
    if kind.startswith(_BYTES) or (kind.startswith("uint8[") and isinstance(value, str)):
        octets = base64.b64decode(value) if isinstance(value, str) else bytes(value)
        return list(octets) if kind.startswith("uint8[") else type(default)("B", octets)
    if isinstance(value, list):
        inner = kind.removeprefix("sequence<").partition("[")[0].partition(">")[0].partition(",")[0]
        made = None if "/" not in inner else class_of(inner)
        return [to_ros2(one, made()) if made is not None else _number(one, inner) for one in value]
    if isinstance(value, Mapping):
        return to_ros2(value, default)
    if kind == "octet":
        return bytes([value % 256])
    return _number(value, kind)


def _number(value: Any, kind: str) -> Any:
    if kind.startswith(("float", "double")):
        return math.nan if value is None else float(value)
    return value


def _ros1_value(value: Any, kind: str) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        return to_ros1(value)
    if isinstance(value, bytes):
        return value[0] if kind == "octet" else base64.b64encode(value).decode()
    if kind.startswith((*_BYTES, "uint8[")):
        return base64.b64encode(bytes(value)).decode()
    if not isinstance(value, str) and hasattr(value, "__iter__"):
        return [_ros1_value(one, kind.partition("[")[0].removeprefix("sequence<")) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value.item() if hasattr(value, "item") else value
