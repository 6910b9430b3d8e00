"""Read the membership of one of two appliances, and find what its start needs."""

import asyncio
from collections.abc import Mapping
from pathlib import Path

from appliance.base import clock
from appliance.channel import messages
from appliance.features.standby.membership import (
    LEASE_FILE,
    LEASE_NICE,
    LINK_FILE,
    MembershipError,
    encode,
    load_membership,
    path_of,
)
from appliance.supervisor.errors import StartError
from appliance.supervisor.service_gate import Pairing, RoleChanges, ServiceGate

# Decide by the reports of the lease whether this appliance may serve.
#
# If a lapsed lease is renewed in the same epoch, no other appliance was active in between, and the state in memory
# is still the newest. So a lapse only suspends the processes that serve the robot; without such a renewal they end.

LONGEST_LAPSE = 300.0  # seconds: a boot of the robot; then the appliance stands by, and answers operators
PAUSED = (
    "the appliance is paused: its lease has lapsed, and it answers and relays nothing until the lease is renewed; after"
    f" {LONGEST_LAPSE / 60:g} minutes at most it becomes the standby. Check its load, and its network to the robot and"
    " the other appliance"
)
BECOMES_STANDBY = (
    "this appliance lost its lease, and is starting again as the standby: try again in some seconds"
)

_ROUNDING = 1e-6  # seconds; a timer that was rounded to a time before the end would be set again and again


class LeaseWatch(ServiceGate):
    """The role of one of two appliances, by the reports of the process `lease`."""

    accepts: Mapping[str, tuple[type, ...]] = {"lease": (messages.LeaseHeld, messages.LeaseEnded)}
    member = True
    paused, ended_text = PAUSED, BECOMES_STANDBY

    def __init__(self, changes: RoleChanges) -> None:
        super().__init__(changes)
        self.epoch = None
        self._renewable = True
        self._until = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def heard(self, message: object) -> None:
        match message:
            case messages.LeaseHeld(until, epoch):
                self.held(until, epoch)
            case messages.LeaseEnded(renewable):
                self.lapsed() if renewable else self.ended()

    def died(self, role: str, *, serves_robot: bool) -> None:
        """End a lapse if the process `lease`, which could renew in the same epoch, has died."""
        if role == "lease":
            self.not_renewable()
        elif self.suspended and serves_robot:
            self.ended()

    def held(self, until: float, epoch: int) -> None:
        if self.epoch not in (None, epoch):
            self.ended()
        self._until, self._renewable = until, True
        if self._seconds_left() > 0:
            if self.epoch is None:
                self.epoch = epoch
                self._changes.activate(epoch)
            elif self.suspended:
                self.suspended = False
                self._changes.resume()
        if not self.suspended:
            self._check()

    def lapsed(self) -> None:
        if self.epoch is None or self.suspended:
            return
        self._stop_timer()
        if not self._renewable or not self._changes.suspend():
            self.ended()
            return
        self.suspended = True
        self._timer = asyncio.get_running_loop().call_later(LONGEST_LAPSE, self.ended)

    def ended(self) -> None:
        self._stop_timer()
        if self.epoch is not None:
            self.epoch, self.suspended = None, False
            self._changes.passivate()

    def not_renewable(self) -> None:
        """Note the end of the process `lease`: its successor gets the lease only in a new epoch."""
        self._renewable = False
        if self.suspended:
            self.ended()

    def _check(self) -> None:
        self._stop_timer()
        left = self._seconds_left()
        if left <= _ROUNDING:
            self.lapsed()
        elif self.epoch is not None:
            self._timer = asyncio.get_running_loop().call_later(left, self._check)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _seconds_left(self) -> float:
        return self._until - clock.since_boot()


_FIXED_AUTHORITY = (
    "this appliance is one of two, which share the authority: end the pair first (rosrv standby leave on both), rotate,"
    " and join again"
)


def pairing_in(state: Path) -> Pairing | None:
    try:
        membership = load_membership(path_of(state))
    except MembershipError as error:
        raise StartError(str(error)) from error
    except OSError as error:
        raise StartError(
            f"{state} cannot be used as the state directory: {error.strerror}; name another with --state"
        ) from error
    if membership is None:
        return None
    name, other = membership.name, membership.other
    return Pairing(
        robot=membership.witness,
        other=membership.other_address,
        port=membership.port,
        files=(
            (LEASE_FILE, "rosrv-lease", encode(membership.for_lease())),
            (LINK_FILE, "rosrv", encode(membership.for_control())),
        ),
        nice=LEASE_NICE,
        gate=LeaseWatch,
        fixed_authority=_FIXED_AUTHORITY,
        waiting_event={"event": "standby", "name": name, "other": other},
        waiting_text=f"This appliance ({name}) is ready to be active, or to take over from {other}"
        f" ({membership.other_address}): rosrv standby status",
        ready="ready to take over: rosrv standby status",
    )
