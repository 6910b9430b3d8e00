"""Which topics are never recorded, and by whose word: `recorder.never` has globs of topics and of types.

The name of a topic is what the policy decided. Its type is a claim of the publisher: where the definition of a type is
known, the md5sum in the publisher's header must be that of the type. A topic with another md5sum is recorded. A claim
that fits may still be false, so a recording without such a topic says by whose word it was left out.
"""

from collections.abc import Collection, Iterable, Mapping
from fnmatch import fnmatchcase

NAMED = "recorder.never has its name"

_SHIPPED = {
    "sensor_msgs/Image": "060021388200f6f0f447d0fcd9c64743",
    "sensor_msgs/CompressedImage": "8f7a12909da2c9d3332d540a0977563f",
    "theora_image_transport/Packet": "33ac4e14a7cff32e7e0d65f18bb410f3",
    "audio_common_msgs/AudioData": "f43a8e1b362b75baa741461b46adc7e0",
    "audio_common_msgs/AudioDataStamped": "3cdd84a06846af0dca4d0434908f9d96",
}
"""The types that `never` has unless it is given."""


def known_sums(never: Collection[str]) -> dict[str, str]:
    """The md5sums of the types with known definitions that a glob of `never` fits."""
    if all(glob in _SHIPPED or glob.startswith("/") for glob in never):
        return {name: md5sum for name, md5sum in _SHIPPED.items() if name in never}
    from roswire.standard import standard_definitions  # noqa: PLC0415  only where it is configured

    definitions = standard_definitions()
    known = {name: definitions.md5sum(name) for name in definitions.message_types if fits(never, name)}
    return known | {name: md5sum for name, md5sum in _SHIPPED.items() if fits(never, name)}


def left_out_because(
    never: Collection[str], sums: Mapping[str, str], topic: str, header: Mapping[str, str]
) -> str:
    """Why a publisher's messages are not recorded, in words; empty when they are."""
    if fits(never, topic):
        return NAMED
    name = header.get("type", "")
    if not fits(never, name):
        return ""
    if name not in sums:
        return f"its publisher says that it is {name}, a type whose definition is not known here"
    return f"its publisher says that it is {name}" if header.get("md5sum") == sums[name] else ""


def fits(globs: Iterable[str], name: str) -> bool:
    """Whether any of these globs fits a name."""
    return any(fnmatchcase(name, glob) for glob in globs)
