"""The boot hold: new connections to the machine's ROS ports wait until the appliance serves.

    python -m appliance.network.boot_hold on|off        (rosrv-hold.service)

1. It is in force only while rosrv-hold.service is active, which systemd starts with the enabled rosrv.service, and
   stops with it if an operator does; a crash does not stop it. The unit's runtime directory shows that it is active.
   systemd also restarts it with rosrv.service; then `off` leaves the hold in force, without a gap.
2. It is armed by a start that serves, and disarmed by a release of the robot's graph. An appliance that never served
   since then, or that is off, holds up no host.
3. Other machines: new TCP connections to RVMaster's port and the kernel's range, in which nodes listen, are dropped, so
   their clients try again. Loopback, the appliance's link, established connections and other ports pass. While a graph
   is given back before a restart, only RVMaster's port is held: nodes of other machines then connect with one another.
4. `own`: new connections of the machine to itself on RVMaster's port are also dropped. The kernel ends this part after
   its seconds, even if no process of the appliance runs.
"""

import contextlib
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.network.firewall.backend import Backend, FirewallError
from appliance.network.firewall.firewall_rules import (
    LOOPBACK,
    OUTSIDE,
    Chain,
    Interface,
    PacketRule,
    PacketVerdict,
    PortRange,
)
from appliance.network.firewall.iptables import IptablesBackend
from appliance.network.firewall.nft import NftBackend
from appliance.network.namespaces import Namespace

TABLE = "rosrv-hold"
_SERVICE = "rosrv.service"
UNIT_RUNS = Path("/run/rosrv-hold")  # the unit's RuntimeDirectory
STATE = Path("/var/lib/rosrv-hold")  # the unit's StateDirectory


@dataclass(frozen=True)
class HeldPorts:
    """The ports that are held, and the appliance's link, from which they are not.

    With `own_seconds`, the machine's own connections to the port `master` are also held, for that time.
    """

    master: int
    first: int
    last: int
    link: str = ""
    own_seconds: int | None = None


def hold_rules(held: HeldPorts, own_seconds: int, *, nodes: bool = True) -> tuple[PacketRule, ...]:
    """Return the rules; the machine's own connections are held for `own_seconds` more, or not if that is 0.

    Without `nodes`, only the port of the master is held.
    """
    rules = []
    if held.link:
        rules.append(
            PacketRule(
                "hold: not the appliance",
                PacketVerdict.RETURN,
                chain=Chain.HOLD,
                arrives_on=Interface(held.link),
            )
        )
    if own_seconds > 0:
        rules.append(
            PacketRule(
                "hold: the robot's own programs wait for the appliance",
                PacketVerdict.DROP,
                chain=Chain.HOLD,
                arrives_on=LOOPBACK,
                opening=True,
                tcp_ports=PortRange.one(held.master),
                seconds=own_seconds,
            )
        )
    held_off = [PortRange.one(held.master)]
    if nodes:
        held_off.append(PortRange(held.first, held.last))
    for ports in held_off:
        rules.append(
            PacketRule(
                f"hold: other machines wait for the appliance, TCP {ports}",
                PacketVerdict.DROP,
                chain=Chain.HOLD,
                arrives_on=OUTSIDE,
                opening=True,
                tcp_ports=ports,
            )
        )
    return tuple(rules)


class BootHold:
    """The hold of this machine; without rosrv-hold.service, all calls do nothing."""

    def __init__(self, host: Namespace, *, unit_runs: Path = UNIT_RUNS, state: Path = STATE) -> None:
        self._backends: tuple[Backend, ...] = (
            NftBackend(host, TABLE),
            IptablesBackend(host, (Chain.HOLD,)),
        )
        self._since = unit_runs / "since"  # seconds since the boot, a clock that is never set
        self._in_force = unit_runs / "in-force"  # exists from `put` until `lift`
        self._unit_runs = unit_runs
        self._armed = state / "armed.json"

    @property
    def is_present(self) -> bool:
        return self._unit_runs.is_dir()

    @property
    def is_in_force(self) -> bool:
        """Return whether other machines are held off, unless another program has flushed the rules."""
        return self._in_force.exists()

    def is_intact(self) -> bool:
        """Return whether the rules are as `put` or `lift` left them: another program may have flushed them."""
        return not self.is_in_force or any(map(_holds, self._backends))

    def put(self, *, nodes: bool = True) -> bool:
        """Hold other machines off, if armed; return whether another program had removed the rules of an earlier hold.

        Without `nodes`, they are held off the master alone. Raises `FirewallError`; without a working back end, nothing
        is held.
        """
        held = self._held_ports()
        if held is None:
            return False
        removed = not self.is_intact()
        own = 0 if held.own_seconds is None or not nodes else held.own_seconds - int(self._seconds_so_far())
        reasons = []
        for backend in self._backends:
            try:
                backend.install(hold_rules(held, own, nodes=nodes))
            except FirewallError as error:
                reasons.append(f"{backend.name}: {error}")
            else:
                with contextlib.suppress(OSError):
                    self._in_force.touch()
                return removed
        raise FirewallError(f"other machines are not held off: {'; '.join(reasons)}")

    def lift(self) -> bool:
        """End the hold; return whether it lasted longer than the robot's own programs were held.

        Raises `FirewallError` if its rules are still in force.
        """
        try:
            held = self._held_ports()
        except FirewallError:
            held = None
        own = None if held is None else held.own_seconds
        lapsed = own is not None and self._since.exists() and self._seconds_so_far() > own
        self._since.unlink(missing_ok=True)
        self._in_force.unlink(missing_ok=True)
        reasons = []
        for backend in self._backends:
            try:
                backend.remove()
            except FirewallError as error:
                if _holds(backend):
                    reasons.append(f"{backend.name}: {error}")
        if reasons:
            raise FirewallError(f"other machines are still held off: {'; '.join(reasons)}")
        return lapsed

    def arm(self, held: HeldPorts | None) -> None:
        """Hold these ports at the next boot and at the end of this run; None: hold nothing. Raises `OSError`."""
        if held is None:
            self._armed.unlink(missing_ok=True)
        elif self.is_present:
            write_whole(self._armed, json.dumps(asdict(held)).encode(), 0o600)

    def _held_ports(self) -> HeldPorts | None:
        if not self.is_present:
            return None
        try:
            return HeldPorts(**json.loads(self._armed.read_bytes()))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError) as error:
            raise FirewallError(
                f"{self._armed} cannot be read ({error}): the next start that serves writes it"
            ) from None

    def _seconds_so_far(self) -> float:
        """Return the seconds since the hold began, which a restart of the appliance does not change."""
        now = clock.since_boot()
        try:
            return now - float(self._since.read_text(encoding="ascii"))
        except (OSError, ValueError):
            with contextlib.suppress(OSError):
                self._since.write_text(str(now), encoding="ascii")
            return 0.0


def _holds(backend: Backend) -> bool:
    """Return whether the rules of a back end that works are in force."""
    with contextlib.suppress(FirewallError):
        return bool(backend.counters())
    return False


def starts_again() -> bool:
    """Return whether systemd is to start rosrv.service, as after the stop of a restart."""
    command = ["systemctl", "list-jobs", "--no-legend", "--plain", _SERVICE]
    try:
        jobs = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False).stdout
    except (OSError, subprocess.TimeoutExpired):
        return False
    rows = [line.split() for line in jobs.splitlines()]  # number, unit, type, state
    return any(len(row) >= 3 and row[1] == _SERVICE and row[2].endswith("start") for row in rows)


def main(arguments: Sequence[str]) -> None:
    hold = BootHold(Namespace.own())
    try:
        if list(arguments) == ["on"]:
            hold.put()
        elif list(arguments) == ["off"]:
            if not starts_again():
                hold.lift()
        else:
            sys.exit("usage: python -m appliance.network.boot_hold on|off")
    except FirewallError as error:
        sys.exit(f"rosrv: {error}")


if __name__ == "__main__":
    main(sys.argv[1:])
