"""What control knows of the rest of the appliance: told by the supervisor, shown by `rosrv status` and REST."""

from appliance.channel.messages import FirewallReported, ProcessInfo


class Surroundings:
    """What the supervisor told control last; `probe` is empty before the first, then `passed` or the reason."""

    def __init__(self) -> None:
        self.processes: list[ProcessInfo] = []
        self.firewall = FirewallReported("unknown", {})
        self.probe = ""
