"""Build the part of control for approvals."""

import secrets

from appliance.control.core import ControlPart, Core
from appliance.control.motion_stop import MotionStop
from appliance.control.operators.request_method import RequestMethod
from appliance.features.approvals import requests
from appliance.features.approvals.feature import HOOK
from appliance.features.approvals.hook import WebHook, with_hook
from appliance.features.approvals.hook_link import HookLink
from appliance.features.approvals.orders import ApprovalOrders
from appliance.features.approvals.settings import ApprovalHook
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy


async def begin(core: Core) -> ControlPart:
    """Begin without approvals, and stop motions that hosts commanded under earlier ones.

    The first number is random, so an operator who answers after a restart does not approve another call.
    """
    policy = core.policy
    stop = MotionStop(core.relay.stop, core.trail, policy.current)
    hook = WebHook(wanted=core.settings.of(ApprovalHook).url is not None)
    core.links.attach(HOOK, hook.link, HookLink)
    orders = ApprovalOrders(
        policy.current,
        core.trail,
        core.graph.signs,
        stop.after,
        core.ends,
        first=10_000 + secrets.randbelow(80_000),
        decide_again=policy.decide_again,
        carried_out=core.relay.carried_out,
        bearers=core.bearers.usable,
        guards=core.relay.stoppers,
        held=hook.notify,
    )
    at_start = stop.of_published_before(
        core,
        lambda: any(rule.asked for rule in policy.current().rules(Category.PUBLISH)),
        lambda host, topic: _asks(policy.current(), host, topic),
    )
    core.limits.provide(orders.limits)
    policy.provide(lambda known: known.with_approvals(orders.approved()))
    policy.on_change(orders.policy_changed)
    core.relay.hold(orders.hold_call, orders.approve_call)
    return ControlPart(
        (
            RequestMethod(requests.ApprovalsWanted, orders.listed),
            RequestMethod(requests.ApproveCall, orders.approve, who=True, full_disk=True),
            RequestMethod(requests.RefuseCall, orders.refuse, who=True, full_disk=True),
        ),
        {
            "the end of approvals": orders.watch,
            "the stop of what was commanded before approvals ended": at_start,
        },
        lambda: {"approvals": with_hook(orders.state(), hook)},
    )


def _asks(policy: Policy, host: Address, topic: str) -> bool:
    return policy.decide(Request(host, "", Category.PUBLISH, topic)).asks is not None
