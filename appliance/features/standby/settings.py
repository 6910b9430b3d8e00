"""The section `availability` of `appliance.yaml`."""

from typing import ClassVar, Literal

from appliance.configuration.sections import FeatureSection, key, section


@section
class Availability(FeatureSection):
    """Two appliances, of which one takes over from the other; `rosrv standby join` makes them a pair."""

    place: ClassVar[str] = "availability"
    wait: Literal["standby", "none"] = key(
        default="standby",
        description="an answer to a node waits until the standby has stored the change; none: it does not wait, and a"
        " takeover may lose the last changes",
    )
