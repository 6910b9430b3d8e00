"""The memory of a relay for tests of its parts."""

from appliance.quotas.pool import Bounds, Standing
from appliance.relay.connections.memory import HostShare, HostShares


def share(limit: int = 1 << 30) -> HostShare:
    """The share of a host that is alone and may hold so many bytes."""
    bounds = Bounds(2 * limit, 2 * limit, 0, 0)
    return HostShares("bytes", bounds, lambda _host: Standing.REGISTERED).of("host")
