"""List the features of the product. The core imports only this module and `feature.py` of the folder `features`.

To remove a feature, remove its folder, and its import and its row here.
"""

from typing import TYPE_CHECKING, Any

from appliance.features.evidence.feature import EVIDENCE
from appliance.features.feature import Feature, FeatureContext
from appliance.features.standby.feature import STANDBY
from appliance.features.syslog.feature import SYSLOG

if TYPE_CHECKING:
    from appliance.channel.answers.status import ForwardingState
    from appliance.channel.link import Link
    from appliance.control.operators.request_method import RequestMethod

FEATURES: tuple[Feature, ...] = (SYSLOG, EVIDENCE, STANDBY)


class FeatureParts:
    """The parts of all features in control."""

    def __init__(self, core: FeatureContext) -> None:
        self._parts = [feature.make(core) for feature in FEATURES if feature.make is not None]

    def link(self, role: str) -> "tuple[Link, Any] | None":
        """Return control's end of the link to a role, with the accepted messages; None for an unknown role."""
        return next((part.links[role] for part in self._parts if role in part.links), None)

    def methods(self) -> "tuple[RequestMethod[Any], ...]":
        """Return the methods that answer the features' requests."""
        return tuple(method for part in self._parts for method in part.methods)

    def forwarding(self) -> "ForwardingState | None":
        """Return the state of the forwarding of the audit log, or None if none is configured."""
        return next(filter(None, (part.forwarding() for part in self._parts)), None)
