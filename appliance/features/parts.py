"""Keep the parts of control that the features of the table add."""

import pkgutil
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from appliance.control.assembly.current import Current
from appliance.features.feature import FeatureContext, FeaturePart, KeptHosts, OperatorContext
from appliance.features.table import FEATURES
from appliance.hosts.tunnel_hosts import TunnelHosts

if TYPE_CHECKING:
    from appliance.channel.answers.limit_answers import LimitUse
    from appliance.channel.link import Link
    from appliance.channel.messages import (
        ApprovalAnswered,
        ApprovalWanted,
        OwnServiceAnswered,
        OwnServiceCalled,
    )
    from appliance.channel.messages.api import TokenKept
    from appliance.control.operators.request_method import RequestMethod
    from appliance.control.operators.sessions import Sessions
    from appliance.policy.model import Address, Request
    from appliance.policy.policy import Approval

LONGEST = 64 << 20
"""The largest message in bytes, unless a part sets a smaller limit."""


_NO_APPROVALS = "no operator can approve calls on this appliance"


class FeatureParts:
    """The parts of all features in control."""

    def __init__(self, core: FeatureContext) -> None:
        self._core = core
        self._no_hosts = TunnelHosts()
        self.kept: dict[str, KeptHosts] = {}
        self.bearers: Current[Callable[[], list[TokenKept]]] = Current()
        """Returns the usable tokens and sessions."""
        self._parts: list[FeaturePart] = []
        for feature in FEATURES:
            self.add(feature.make(core) if feature.make is not None else None)

    async def keep(self, store: Any, lifeline: Any) -> None:
        """Read the hosts in the state, before the policy comes into force."""
        for feature in FEATURES:
            if feature.keep is not None:
                keep = pkgutil.resolve_name(feature.keep)
                self.kept[feature.name] = await keep(self._core.sections, store, lifeline)

    def addresses(self) -> "dict[str, Address]":
        return {name: address for kept in self.kept.values() for name, address in kept.addresses().items()}

    def connected(self, door: str, ticket: str, peer: str, descriptor: int) -> tuple[int, str]:
        connected = next(filter(None, (part.connected for part in self._parts)), None)
        return (
            connected(door, ticket, peer, descriptor)
            if connected is not None
            else (404, "there are no doors")
        )

    def operate(self, **later: Any) -> None:
        context = OperatorContext(self._core, **later, hosts=self.hosts(), kept=self.kept)
        for feature in FEATURES:
            self.add(feature.operate(context) if feature.operate is not None else None)

    async def inherit(self, foundation: Any, parts: Any) -> None:
        for feature in FEATURES:
            if feature.inherit is not None:
                self.add(await pkgutil.resolve_name(feature.inherit)(foundation, parts))

    def add(self, part: FeaturePart | None) -> None:
        if part is None:
            return
        self._parts.append(part)
        if part.details is not None:
            self._core.trail.add_details(part.details)

    def link(self, role: str, index: int = 0) -> "tuple[Link, Any] | None":
        """Return the link to a process. The second process of a role has the name `ROLE-2`."""
        name = f"{role}-{index + 1}" if index else role
        return next((part.links[name] for part in self._parts if name in part.links), None)

    def longest(self, role: str) -> int:
        return next((part.longest[role] for part in self._parts if role in part.longest), LONGEST)

    def methods(self) -> "tuple[RequestMethod[Any], ...]":
        return tuple(method for part in self._parts for method in part.methods)

    def state(self) -> dict[str, Any]:
        return {field: state for part in self._parts for field, state in part.status_fields().items()}

    def limits(self) -> "tuple[LimitUse, ...]":
        return tuple(use for part in self._parts for use in part.limits())

    async def called(self, call: "OwnServiceCalled") -> "OwnServiceAnswered":
        (called,) = (
            answer
            for part in self._parts
            for name, answer in part.called.items()
            if call.service.endswith(f"/{name}")
        )
        return await called(call)

    def holders(self) -> "dict[str, Address]":
        return {group: host for part in self._parts for group, host in part.holders().items()}

    def approved(self) -> "frozenset[Approval]":
        return frozenset(approval for part in self._parts for approval in part.approved())

    def policy_changed(self) -> None:
        for part in self._parts:
            part.policy_changed()

    def hold_call(self, request: "Request") -> str:
        hold = next((part.hold_call for part in self._parts if part.hold_call is not None), None)
        return _NO_APPROVALS if hold is None else hold(request)

    async def approve(self, wanted: "ApprovalWanted") -> "ApprovalAnswered":
        approve = next((part.approve for part in self._parts if part.approve is not None), None)
        if approve is not None:
            return await approve(wanted)
        from appliance.channel.messages import ApprovalAnswered  # noqa: PLC0415  few processes need it

        return ApprovalAnswered(wanted.number, _NO_APPROVALS)

    def sessions(self) -> "Sessions | None":
        return next((part.sessions for part in self._parts if part.sessions is not None), None)

    def hosts(self) -> TunnelHosts:
        return next((part.hosts for part in self._parts if part.hosts is not None), self._no_hosts)

    async def before_end(self) -> None:
        for part in self._parts:
            if part.before_end is not None:
                await part.before_end()

    def work(self) -> dict[str, Callable[[], Awaitable[None]]]:
        return {what: one for part in self._parts for what, one in part.work.items()}
