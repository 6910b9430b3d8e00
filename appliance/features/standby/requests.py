"""The requests of operators' tools to one of two appliances."""

from appliance.channel.admin import AdminRequest, WaitingRequest
from appliance.channel.rest_operation import rest
from appliance.features.standby.answers import StandbyState


@rest(
    "viewer", "GET", "/v1/standby", name="standby", tag="status",
    problems={404: "This appliance is not one of two."},
)  # fmt: skip
class StandbyWanted(AdminRequest[StandbyState], frozen=True, tag="standby"):
    """This appliance, the other one, and the witness on the robot. The standby also answers this request."""


@rest(
    "admin", "POST", "/v1/standby/switch", name="switch_standby", tag="status",
    problems={404: "This appliance is not one of two."},
)  # fmt: skip
class StandbyPromote(WaitingRequest[StandbyState], frozen=True, tag="standby promote"):
    """Make the standby the active appliance: a planned switchover. The answer may be lost, because this appliance
    becomes the standby; `GET /v1/standby` shows the result.
    """


REQUESTS = (StandbyWanted, StandbyPromote)
