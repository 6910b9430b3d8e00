"""Exclude topics from recordings: `recorder.never` has globs for names of topics and types.

A type is only a claim of the publisher. A topic whose md5sum differs from the known definition is recorded anyway. A
claim with the right md5sum may still be false, so each recording lists the topics that were left out by type.
"""

from collections.abc import Collection, Iterable, Mapping
from fnmatch import fnmatchcase

from roswire.standard import standard_definitions

NAMED = "recorder.never lists its name"

_SHIPPED = {
    "sensor_msgs/Image": "060021388200f6f0f447d0fcd9c64743",
    "sensor_msgs/CompressedImage": "8f7a12909da2c9d3332d540a0977563f",
    "theora_image_transport/Packet": "33ac4e14a7cff32e7e0d65f18bb410f3",
    "audio_common_msgs/AudioData": "f43a8e1b362b75baa741461b46adc7e0",
    "audio_common_msgs/AudioDataStamped": "3cdd84a06846af0dca4d0434908f9d96",
}
"""The MD5 sums of the types in the default of `never`."""


def known_sums(never: Collection[str]) -> dict[str, str]:
    if all(glob in _SHIPPED or glob.startswith("/") for glob in never):
        return {name: md5sum for name, md5sum in _SHIPPED.items() if name in never}
    definitions = standard_definitions()
    known = {name: definitions.md5sum(name) for name in definitions.message_types if fits(never, name)}
    return known | {name: md5sum for name, md5sum in _SHIPPED.items() if fits(never, name)}


def left_out_because(
    never: Collection[str], sums: Mapping[str, str], topic: str, header: Mapping[str, str]
) -> str:
    if fits(never, topic):
        return NAMED
    name = header.get("type", "")
    if not fits(never, name):
        return ""
    if name not in sums:
        return f"its publisher declares the type {name}, whose definition is unknown here"
    return f"its publisher declares the type {name}" if header.get("md5sum") == sums[name] else ""


def fits(globs: Iterable[str], name: str) -> bool:
    return any(fnmatchcase(name, glob) for glob in globs)
