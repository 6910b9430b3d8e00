"""Build the part of control for approvals."""

import secrets

import msgspec

from appliance.base import clock
from appliance.channel.channel import ChannelFullError
from appliance.channel.link import Link
from appliance.control.core import ControlPart, Core
from appliance.control.motion_stop import MotionStop
from appliance.control.operators.request_method import RequestMethod
from appliance.features.approvals import requests
from appliance.features.approvals.approval_table import ApprovalEntry
from appliance.features.approvals.feature import HOOK
from appliance.features.approvals.hook_link import CallSent, CallWaits, HookLink
from appliance.features.approvals.orders import ApprovalOrders
from appliance.features.approvals.settings import ApprovalHook
from appliance.features.approvals.view import ApprovalCounts
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy

# Control's end of the link to the process `hook`: passes calls on, and counts unsent ones.

UNSENT_SECONDS = 600.0


class WebHook:
    """Passes on each call that begins to wait; `wanted` is whether a web hook is configured."""

    def __init__(self, *, wanted: bool) -> None:
        self.wanted = wanted
        self.link = Link(self.heard)
        self._unsent: list[float] = []
        self._trouble = ""

    def notify(self, entry: ApprovalEntry, seconds: float) -> None:
        """Tell it at once; nothing here waits, and a failure changes nothing for the call."""
        if not self.wanted:
            return
        call = entry.call
        message = CallWaits(
            entry.number, str(call.host), entry.caller_id, call.category.value, call.resource, entry.type,
            seconds,
        )  # fmt: skip
        try:
            if not self.link.send(message):
                self._failed("its process is not running")
        except ChannelFullError:
            self.link.close()
            self._failed("its process does not read")

    def heard(self, message: object) -> None:
        if isinstance(message, CallSent) and message.trouble:
            self._failed(message.trouble)
        elif isinstance(message, CallSent):
            self._unsent.clear()

    def _failed(self, trouble: str) -> None:
        self._unsent.append(clock.now())
        self._trouble = trouble

    def unsent(self) -> tuple[int, str]:
        """Return the number of unsent calls in the last ten minutes, or since the last sent one, and the reason."""
        self._unsent = [at for at in self._unsent if clock.now() - at < UNSENT_SECONDS]
        return len(self._unsent), self._trouble if self._unsent else ""


def with_hook(counts: ApprovalCounts, hook: WebHook) -> ApprovalCounts:
    number, why = hook.unsent()
    return msgspec.structs.replace(counts, unsent=number, unsent_why=why)


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
            RequestMethod(requests.ApprovalsWanted, orders.list_approvals),
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
