"""Build the part of control for blocks of hosts."""

from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.blocks.orders import BlockOrders, is_own
from appliance.features.blocks.requests import HostBlock, HostBlocks, HostUnblock


async def begin(core: Core) -> ControlPart:
    orders = BlockOrders(
        core.hosts.blocks,
        core.policy.revisions,
        core.store,
        core.trail,
        core.ends,
        live=core.graph.live_rights,
        connected=core.graph.connected,
        enrolled=lambda: {
            **core.hosts.names(),
            **{name: str(address) for name, address in core.policy.hosts().items()},
        },
        remotes=lambda: {name: seen.remote for name, seen in core.hosts.tunnels.seen.items()},
        uses=core.hosts.blocks.uses.of,
        carried_out=core.relay.carried_out,
        is_own=is_own,
    )
    return ControlPart(
        (
            RequestMethod(HostBlock, orders.block, who=True, full_disk=True),
            RequestMethod(HostUnblock, orders.unblock, who=True),
            RequestMethod(HostBlocks, orders.list_blocks, order=False),
        )
    )
