"""Build the part of control for the audit log's forwarder."""

from appliance.channel.messages import ForwardingLink
from appliance.control.core import ControlPart, Core
from appliance.control.links.forwarder_link import ForwarderLink
from appliance.features.syslog.feature import ROLE
from appliance.features.syslog.settings import Syslog


async def begin(core: Core) -> ControlPart:
    wanted = core.settings.of(Syslog)
    forwarded = ForwarderLink(wanted.to, wanted.send, core.trail)
    core.links.attach(ROLE, forwarded.link, ForwardingLink)
    return ControlPart(status=lambda: {"forwarding": forwarded.status()})
