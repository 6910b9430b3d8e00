"""Put, lift and arm the boot hold around a run of the appliance. A hold that fails is logged, and ends nothing."""

import structlog

from appliance.configuration.settings import Settings
from appliance.network.boot_hold import BootHold, HeldPorts
from appliance.network.close_ports import local_port_range
from appliance.network.namespaces import Namespace, NetworkError

log = structlog.get_logger()


class HoldAround:
    """The boot hold of the service; `used`: this is the service of a single appliance."""

    def __init__(self, settings: Settings, *, used: bool, link: str, hold: BootHold | None = None) -> None:
        self._hold = hold or BootHold(Namespace.own())
        self._ports: HeldPorts | None = None
        if (
            used
            and settings.isolation != "none"
            and settings.firewall.hold != "off"
            and self._hold.is_present
        ):
            nodes = local_port_range()
            own = settings.firewall.hold_seconds if settings.firewall.hold == "own" else None
            self._ports = HeldPorts(settings.listen_address[1], nodes.first, nodes.last, link, own)

    def put(self) -> None:
        if self._ports is not None:
            try:
                self._hold.put()
            except (NetworkError, OSError) as error:
                log.error(
                    "other machines are not held off while the appliance does not serve", error=str(error)
                )

    def served(self) -> str:
        """Lift and arm the hold.

        Return an alarm if it is not lifted, or if the robot's own programs started without the appliance.
        """
        if not self._hold.is_present:
            return ""
        lapsed, trouble = False, ""
        try:
            lapsed = self._hold.lift()
        except (NetworkError, OSError) as error:
            trouble = f"{error}: run `systemctl stop rosrv-hold`, which tries again"
            log.error("the boot hold is not lifted", error=str(error))
        try:
            self._hold.arm(self._ports)
        except OSError as error:
            log.error("the hold of the next boot keeps its last settings", error=str(error))
        if trouble or not lapsed or self._ports is None or self._ports.own_seconds is None:
            return trouble
        return (
            f"the appliance served more than {self._ports.own_seconds} s after the hold began, so the robot's own "
            "programs may have started without it: restart them"
        )
