"""What control knows of the rest of the appliance: told by the supervisor, shown by `rosrv status` and REST."""

from appliance.channel.messages import FirewallReported, ProcessInfo


class Surroundings:
    """What the supervisor told control last; `probe` is empty before the first, then `passed` or the reason.

    `master` is where nodes find their master, as they are told; empty before control is ready.
    """

    def __init__(self) -> None:
        self.processes: list[ProcessInfo] = []
        self.firewall = FirewallReported("unknown", {})
        self.probe = ""
        self.master = ""
