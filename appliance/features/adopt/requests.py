"""Define the requests of `rosrv adopt` and `rosrv release`. They are orders on the machine only, never over REST."""

from appliance.channel.admin import AdminRequest, WaitingRequest
from appliance.channel.rest_operation import rest
from appliance.features.adopt.adopt_answers import AdoptState, GiveBackReport, TakeOverReport


@rest(None)
class AdoptStatus(AdminRequest[AdoptState], frozen=True, tag="adopt status"):
    """The state of the adoption."""


@rest(None)
class AdoptOrder(WaitingRequest[TakeOverReport], frozen=True, tag="adopt"):
    """Take the robot's graph over, now and at each start."""


@rest(None)
class ReleaseOrder(WaitingRequest[GiveBackReport], frozen=True, tag="release"):
    """Give the robot's graph back, now and for good."""


REQUESTS = (AdoptStatus, AdoptOrder, ReleaseOrder)
