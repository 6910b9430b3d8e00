"""Put, lift and arm the boot hold around a run of the appliance. A hold that fails is logged, and ends nothing."""

import asyncio
import math
from collections.abc import Callable

import structlog

from appliance.base import clock
from appliance.base.counted import counted
from appliance.configuration.settings import Settings
from appliance.network.boot_hold import BootHold, HeldPorts, starts_again
from appliance.network.close_ports import local_port_range
from appliance.network.namespaces import Namespace, NetworkError

_LOOK_SECONDS = 5.0
_KEEP_SECONDS = 0.5

log = structlog.get_logger()


class HoldAround:
    """The boot hold of the service; `used`: this is the service of a single appliance."""

    def __init__(self, settings: Settings, *, used: bool, link: str, hold: BootHold | None = None) -> None:
        self._hold = hold or BootHold(Namespace.own())
        self._ports: HeldPorts | None = None
        self._looked_at = -math.inf
        self._removed = 0
        self._served: str | None = None
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
            self._looked_at = clock.now()
            try:
                if self._hold.put():
                    self._removed += 1
                    log.critical("another program removed the boot hold: it is in force again")
            except (NetworkError, OSError) as error:
                log.error(
                    "other machines are not held off while the appliance does not serve", error=str(error)
                )

    def put_before_restart(self) -> None:
        """Hold other machines off the master before an ordered restart gives the robot's graph back to its own one."""
        if self._ports is not None and starts_again():
            try:
                self._hold.put(nodes=False)
            except (NetworkError, OSError) as error:
                log.error("other machines reach the robot's own master until the restart", error=str(error))

    def keep(self) -> None:
        """Restore the hold if another program has removed its rules; looks every five seconds at most."""
        if self._ports is not None and clock.now() - self._looked_at >= _LOOK_SECONDS:
            self._looked_at = clock.now()
            if not self._hold.is_intact():
                self.put()

    async def until(self, is_open: Callable[[], bool]) -> str:
        """Keep the hold until other machines reach the appliance, and not the robot's own master; see `served`."""
        while not is_open():
            self.keep()
            await asyncio.sleep(_KEEP_SECONDS)
        return self.served()

    def served(self) -> str:
        """Lift and arm the hold, once.

        Return an alarm if it is not lifted, if another program had removed its rules, or if the robot's own programs
        started without the appliance.
        """
        if self._served is None:
            self._served = self._lifted()
        return self._served

    def _lifted(self) -> str:
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
        if self._removed and not trouble:
            trouble = (
                f"another program removed the boot hold {counted(self._removed, 'time')}, such as `nft flush ruleset`:"
                " until it was restored, other machines could reach the robot's master and nodes past the appliance"
            )
        if trouble or not lapsed or self._ports is None or self._ports.own_seconds is None:
            return trouble
        return (
            f"the appliance served more than {self._ports.own_seconds} s after the hold began, so the robot's own "
            "programs may have started without it: restart them"
        )
