"""The section `recorder` of `appliance.yaml`."""

from typing import Annotated, ClassVar, Literal

from appliance.configuration.quantities import BYTES, Count, Seconds, WithinAnHour, rules
from appliance.configuration.sections import FeatureSection, key, section


@section
class RecorderRules(FeatureSection):
    """The flight recorder: messages from before and after an incident. Off by default, because it stores contents."""

    place: ClassVar[str] = "recorder"
    enabled: bool = key(default=False, description="whether anything is recorded")
    memory: Annotated[int, BYTES, rules(ge=16 << 20)] = key(
        default=64 << 20,
        description="of all relays together, for the last messages received; it survives a relay's crash",
    )
    before: WithinAnHour = key(default=60.0, description="seconds before the event")
    after: WithinAnHour = key(default=10.0, description="seconds after the event")
    longest: WithinAnHour = key(
        default=600.0, description="longest recording in seconds, regardless of further events"
    )
    topics: list[str] = key(default=["/*"], description="recorded topics: names, `*` matches anything")
    never: list[str] = key(
        default=[
            "sensor_msgs/Image",
            "sensor_msgs/CompressedImage",
            "theora_image_transport/Packet",
            "audio_common_msgs/AudioData",
            "audio_common_msgs/AudioDataStamped",
        ],
        description="names or types that are never recorded; default: cameras and microphones",
    )
    triggers: list[Literal["drop", "change", "verdict", "fault", "stop", "denial", "alarm", "service"]] = key(
        default=["drop", "verdict", "fault", "stop", "alarm", "service"],
        description="triggers of a recording, besides an operator; service: a node's call, if the policy lets it",
    )
    per_hour: Count = key(
        default=6, description="recordings that one host may start with one kind of trigger"
    )
    disk: Annotated[int, BYTES, rules(ge=64 << 20)] = key(
        default=2 << 30, description="of all recordings; one uses at most an eighth of it"
    )
    days: Seconds | None = key(
        default=30.0, description="after which a recording is removed; with null, never"
    )

    def __post_init__(self) -> None:
        if self.longest < self.before + self.after:
            raise ValueError(
                f"longest is {self.longest:g}, but before and after together are {self.before + self.after:g}: set"
                " longest to this at least"
            )

    def services(self) -> tuple[str, ...]:
        return ("record_now",) if self.enabled and "service" in self.triggers else ()
