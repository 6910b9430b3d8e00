"""Build the part of control for approvals."""

import secrets
from functools import partial
from typing import TYPE_CHECKING

from appliance.control.motion_stop import Commands, MotionStop, published_before
from appliance.control.operators.request_method import RequestMethod
from appliance.features.approvals import approval_requests as requests
from appliance.features.approvals.approval_orders import ApprovalOrders
from appliance.features.approvals.feature import HOOK
from appliance.features.approvals.hook import WebHook, with_hook
from appliance.features.approvals.hook_link import HookLink
from appliance.features.approvals.settings import ApprovalHook
from appliance.features.feature import FeaturePart
from appliance.master.endpoints.host_signs import host_signs
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy

if TYPE_CHECKING:
    from appliance.control.assembly.assembly import Parts
    from appliance.control.assembly.foundation import Foundation


async def inherit(base: "Foundation", parts: "Parts") -> FeaturePart:
    """Begin without approvals, and stop motions that hosts commanded under earlier ones.

    The first number is random, so an operator who answers after a restart does not approve another call.
    """
    relay, policy = parts.endpoints.relay, base.policies.policy
    stop = MotionStop(relay.taps.stop, base.trail, policy)
    lost: Commands = set()
    if any(rule.asked for rule in policy().rules(Category.PUBLISH)):
        lost = published_before(base.store, lambda host, topic: _asks(policy(), host, topic))
    hook = WebHook(wanted=base.settings.of(ApprovalHook).url is not None)
    orders = ApprovalOrders(
        policy,
        base.trail,
        host_signs(parts.core.registry, parts.core.carried),
        stop,
        base.ends,
        first=10_000 + secrets.randbelow(80_000),
        decide_again=base.policies.decide_again,
        carried_out=relay.carried_out,
        bearers=lambda: base.features.bearers()(),  # noqa: PLW0108  set later
        guards=relay.taps.guards,
        held=hook.notify,
    )

    return FeaturePart(
        {HOOK: (hook.link, HookLink)},
        methods=(
            RequestMethod(requests.ApprovalsWanted, orders.listed),
            RequestMethod(requests.ApproveCall, orders.approve, who=True, full_disk=True),
            RequestMethod(requests.RefuseCall, orders.refuse, who=True, full_disk=True),
        ),
        status_fields=lambda: {"approvals": with_hook(orders.state(), hook)},
        limits=orders.limits,
        approved=orders.approved,
        policy_changed=orders.policy_changed,
        hold_call=orders.hold_call,
        approve=orders.approve_call,
        work={
            "the end of approvals": orders.watch,
            "the stop of what was commanded before approvals ended": partial(stop.at_start, lost, relay),
        },
    )


def _asks(policy: Policy, host: Address, topic: str) -> bool:
    return policy.decide(Request(host, "", Category.PUBLISH, topic)).asks is not None
