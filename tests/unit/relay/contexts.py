from appliance.channel.messages import GrantInstalled
from appliance.relay.context import RelayContext
from appliance.relay.grant_table import GrantTable
from appliance.relay.loop import EventLoop
from appliance.relay.monitors.interceptor import Interceptor
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.report import Reporter

LIMITS = RelayLimits()


def context_of(
    loop: EventLoop,
    limits: RelayLimits = LIMITS,
    *,
    reporter: Reporter | None = None,
    interceptor: Interceptor | None = None,
    named_hosts: tuple[str, ...] = (),
) -> RelayContext:
    """Return the real parts of a relay, in whose policy `named_hosts` are named."""
    reporter = reporter or Reporter(limits)
    interceptor = interceptor or Interceptor(
        loop, reporter, budget=1.0, publish=lambda _message: None, changed=lambda _topics: None
    )
    table = GrantTable()
    for host in named_hosts:
        table.state(GrantInstalled("k", "/chatter", host, "/listener"))
    return RelayContext.of(loop, limits, reporter, interceptor, table)
