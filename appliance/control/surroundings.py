"""What control knows of the rest of the appliance: told by the supervisor, shown by `rosrv status` and REST."""

from appliance.channel.answers.status import FirewallState, ProcessInfo
from appliance.channel.messages import FirewallReported


class Surroundings:
    """What the supervisor told control last; `probe` is empty before the first, then `passed` or the reason.

    `master` is where nodes find their master, as they are told; empty before control is ready.
    """

    def __init__(self) -> None:
        self.processes: list[ProcessInfo] = []
        self.firewall = FirewallReported("unknown", FirewallState())
        self.probe = ""
        self.master = ""
