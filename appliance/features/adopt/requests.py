"""Define the requests of `rosrv adopt` and `rosrv release`.

They are orders on the machine only. None has a row of `@rest`, so control rejects them on every link: from the api
process, whatever token it names, and from all others but the admin socket.
"""

from appliance.channel.admin import AdminRequest, WaitingRequest
from appliance.features.adopt.adopt_answers import AdoptState, GiveBackReport, TakeOverReport


class AdoptStatus(AdminRequest[AdoptState], frozen=True, tag="adopt status"):
    """The state of the adoption."""


class AdoptOrder(WaitingRequest[TakeOverReport], frozen=True, tag="adopt"):
    """Take the robot's graph over, now and at each start."""


class ReleaseOrder(WaitingRequest[GiveBackReport], frozen=True, tag="release"):
    """Give the robot's graph back, now and for good."""


REQUESTS = (AdoptStatus, AdoptOrder, ReleaseOrder)
