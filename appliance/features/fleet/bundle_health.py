"""Compare the robot's health before and after a change: denials, monitors, processes.

All denials of the robot's own nodes count, but only a few of every other host, because one host may cause many on
purpose.
"""

import contextlib
import ipaddress
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Self

from appliance.base.counted import counted
from appliance.channel.answers.status import MinuteState, ProcessInfo
from appliance.control.assembly.monitor_states import monitors_status
from appliance.policy.model import Address
from appliance.policy.policy import Policy
from appliance.specifications.specification_manager import SpecificationManager
from appliance.telemetry.audit_trail import Meter

_MORE_OFTEN = 3  # a change may not make denials this many times as frequent
_ATTENTION_AT = MinuteState(0, {}).attention_at
_OF_ONE_HOST, _OF_OTHER_HOSTS = 3, 12


def counted_denials(
    by_host: Mapping[str, int], policy: Policy, deprived: Callable[[Address], bool] = lambda _host: False
) -> int:
    """Return the number of denials that count. Addresses that the policy names as one network count as one host.

    In `by_host`, an empty name has the denials of all unknown hosts.
    """
    own, others = 0, Counter[str]()
    for host, number in by_host.items():
        address = _address(host)
        if address is not None and any(address in network for network in policy.robot):
            own += number
        elif address is None or not deprived(address):
            others["" if address is None else policy.alike(address)] += number
    return own + min(_OF_OTHER_HOSTS, sum(min(_OF_ONE_HOST, number) for number in others.values()))


def _address(host: str) -> Address | None:
    with contextlib.suppress(ValueError):  # an unknown host, or a caller without an address
        return ipaddress.ip_address(host)
    return None


class RobotHealth(NamedTuple):
    """The denials of the last minute, failing monitors, and processes that keep ending."""

    denials: int
    failing: frozenset[str]
    processes: frozenset[str]
    rejected: tuple[str, ...] = ()  # why relays reject the specifications in force

    @classmethod
    def of(
        cls,
        meter: Meter,
        policy: Policy,
        monitors: SpecificationManager,
        processes: Sequence[ProcessInfo],
        deprived: Callable[[Address], bool],
    ) -> Self:
        state = monitors_status(monitors)
        return cls(
            counted_denials(meter.denied_hosts.counts(), policy, deprived),
            frozenset([*state.failing, *state.held]),
            frozenset(process.role for process in processes if process.failing),
            tuple(state.refused),
        )

    def worse_than(self, before: "RobotHealth") -> str:
        most = max(_MORE_OFTEN * before.denials, _ATTENTION_AT)
        if self.rejected and not before.rejected:
            return f"a relay rejects the specifications: {self.rejected[0]}"
        if self.failing - before.failing:
            return f"monitors fail or hold their topics: {', '.join(sorted(self.failing - before.failing))}"
        if self.processes - before.processes:
            return f"processes keep ending: {', '.join(sorted(self.processes - before.processes))}"
        if self.denials > most:
            return (
                f"{counted(self.denials, 'denial')} in the last minute, {before.denials} in the minute before the"
                " change"
            )
        return ""
