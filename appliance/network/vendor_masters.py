"""Let the robot's own ROS master work beside the appliance, which takes its place.

The processes of its control group are not translated to RVMaster: its `roscore` would otherwise find another master on
its port and end, and systemd would restart the robot's units with each try. A unit has a new control group after each
start, so its drop-in adds the group to the set (`ADD_TO_SET`).

Only packets that this machine sends are exempt. For one that arrives, the kernel would look at the socket to which it
goes: that of the robot's own master, which other machines would then reach past the appliance.
"""

import contextlib
from collections.abc import Sequence

import structlog

from appliance.network.cut import run_nft
from appliance.network.firewall.firewall_rules import Chain
from appliance.network.firewall.nft import TABLE
from appliance.network.namespaces import Namespace, NetworkError

SET = "masters"
_SENT = f"{Chain.NAT.value}-OUTPUT"  # the hook of packets that a process of this machine sends
_LEVEL = 2  # system.slice/roscore.service

log = structlog.get_logger()


def leave_alone(namespace: Namespace, groups: Sequence[str]) -> None:
    """Exempt the processes of control groups from the address translation; `add_to_set` exempts another group later."""
    lines = [
        f"add set inet {TABLE} {SET} {{ type cgroupsv2; }}",
        f"insert rule inet {TABLE} {_SENT} socket cgroupv2 level {_LEVEL} @{SET} counter return",
    ]
    try:
        run_nft(namespace, "\n".join(lines) + "\n")
    except NetworkError as error:
        log.warning("a restart of the robot's own master would fail", reason=str(error))
        return
    for group in groups:
        with contextlib.suppress(NetworkError):  # the unit is not running, and has no control group
            run_nft(namespace, f"{add_to_set(group)}\n")


def add_to_set(group: str) -> str:
    """Return the command of nft that exempts a control group, such as `system.slice/roscore.service`."""
    return f'add element inet {TABLE} {SET} {{ "{group}" }}'
