"""Encode and decode the LandShark's messages without ROS. Missing fields are zero; `a__b` means the field `a.b`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MONITORS = Path(__file__).resolve().parents[2] / "monitors"
TRIGGER = "landshark_msgs/PaintballTrigger"
DEFINITIONS = {f"{TRIGGER}.msg": (MONITORS / "msg" / f"{TRIGGER}.msg").read_text()}


class Messages:
    def __init__(self) -> None:
        self.store: Any = get_typestore(Stores.ROS1_NOETIC)
        self.store.register(
            get_types_from_msg(DEFINITIONS[f"{TRIGGER}.msg"], "landshark_msgs/msg/PaintballTrigger")
        )

    def encode(self, kind: str, **fields: object) -> bytes:
        nested: dict[str, Any] = {}
        for path, value in fields.items():
            at = nested
            *above, last = path.split("__")
            for step in above:
                at = at.setdefault(step, {})
            at[last] = value
        return bytes(self.store.serialize_ros1(self._object(long_name(kind), nested), long_name(kind)))

    def decode(self, kind: str, data: bytes) -> Any:
        return self.store.deserialize_ros1(data, long_name(kind))

    def _object(self, kind: str, given: Mapping[str, Any]) -> Any:
        parts: dict[str, Any] = {}
        for name, (node, detail) in self.store.fielddefs[kind][1]:
            value = given.get(name)
            if node == Nodetype.BASE:
                parts[name] = value if value is not None else {"string": "", "bool": False}.get(detail[0], 0)
            elif node == Nodetype.NAME:
                parts[name] = (
                    self._object(detail, value or {}) if value is None or isinstance(value, dict) else value
                )
            elif detail[0][1][0] == "string":
                parts[name] = list(value or [])
            else:
                (_, (base, _)), length = detail
                parts[name] = np.array([0] * length if value is None else value, dtype=base)
        return self.store.types[kind](**parts)


def long_name(kind: str) -> str:
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name}"
