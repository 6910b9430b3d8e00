"""Build the part of control for single sign-on."""

from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.sso import requests
from appliance.features.sso.feature import ROLE
from appliance.features.sso.link import SsoLink
from appliance.features.sso.orders import SsoOrders
from appliance.features.sso.settings import Sso

_LONGEST = 1 << 16


async def begin(core: Core) -> ControlPart:
    configured = core.settings.of(Sso).issuer is not None
    orders = SsoOrders(core.trail, core.ends, core.bearers.changed, configured=configured)
    core.links.attach(ROLE, orders.link, SsoLink, longest=_LONGEST)
    if configured:
        core.bearers.provide(orders.sessions)
    return ControlPart(
        (
            RequestMethod(requests.SignOnBegin, orders.begin, order=False),
            RequestMethod(requests.SignOnComplete, orders.complete),
            RequestMethod(requests.SessionsWanted, orders.listed, order=False),
            RequestMethod(requests.SignOut, orders.sign_out, who=True, full_disk=True),
            RequestMethod(requests.SessionsEnd, orders.end, who=True, full_disk=True),
        )
    )
