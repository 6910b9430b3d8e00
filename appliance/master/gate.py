"""The one decision point: the policy first, then the binding of claims to hosts, then the limits per host.

`Gate.decide` is a function of the running policy, the registry and the parameters; it forwards nothing and records
nothing. A question that only the network can answer (is the node that holds this name still there?) is returned as
`Contest`, and asked again with the answer.
"""

import ipaddress
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from appliance.master.arguments import ApiUri
from appliance.master.call import Call, Caller, Identity, Touch
from appliance.master.parameters import Tree, holds_others, standing_at
from appliance.master.registry import Incarnation, Kind, Life, Registry
from appliance.policy import Policy
from appliance.policy.model import Category, Decision, Request
from appliance.ros.xmlrpc import Value


@dataclass(frozen=True, slots=True)
class Contest:
    """Another host holds the name; the call is granted only if its node is gone. `decision` is then the answer."""

    holder: Incarnation
    decision: Decision


@dataclass(frozen=True, slots=True)
class HostLimits:
    """How much of the registry one host may take."""

    nodes: int = 500
    registrations: int = 5000


class Gate:
    """Decides calls by the policy that `policy()` returns at that moment."""

    def __init__(self, policy: Callable[[], Policy], registry: Registry, limits: HostLimits) -> None:
        self._policy = policy
        self._registry = registry
        self._limits = limits

    def asked(self, call: Call, arguments: tuple[object, ...]) -> tuple[Category, str]:
        """The category and resource that a call is decided and recorded under."""
        if call.resource is None:
            return Category.COMMAND, call.command or call.name
        return call.category, str(arguments[call.resource])

    def decide(
        self, caller: Caller, call: Call, arguments: tuple[object, ...], tree: Tree
    ) -> Decision | Contest:
        """Whether `caller` may make this call with these canonical arguments, while `tree` are the parameters."""
        if caller.own or self._is_own_subscriber(caller, call, arguments):
            return Decision(True, None, "the appliance's own node")
        decision = self._by_policy(caller, call, arguments, tree)
        if not decision.allowed:
            return decision
        if call.identity is Identity.NOBODY or not caller.caller_id:
            return decision
        denial = (
            self._late(caller, call, arguments)
            or self._unreachable(caller, call, arguments)
            or self._over_limit(caller, call, arguments)
        )
        if denial is not None:
            return denial
        return self._bound(caller, call, decision)

    def may(self, request: Request) -> Decision:
        """Decide one plain question (used when what is live is decided again)."""
        return self._policy().decide(request)

    def may_be_node(self, request: Request) -> Decision:
        """Decide a question about something a node has: its category, then `[Nodes]` for its name."""
        policy = self._policy()
        decision = policy.decide(request)
        if not decision.allowed:
            return decision
        return _both(decision, policy.decide(_node_request(request)))

    # --- the policy ---

    def _by_policy(self, caller: Caller, call: Call, arguments: tuple[object, ...], tree: Tree) -> Decision:
        policy = self._policy()
        host, caller_id = caller.peer.host, caller.caller_id
        category, resource = self.asked(call, arguments)
        decision = policy.decide(Request(host, caller_id, category, resource))
        if decision.allowed and category is not Category.COMMAND and call.command is not None:
            decision = _both(
                decision, policy.decide(Request(host, caller_id, Category.COMMAND, call.command))
            )
        if decision.allowed and call.touches is not None and policy.has_section(Category.READ):
            decision = _both(decision, self._parameter(policy, caller, call, arguments, tree))
        if decision.allowed and call.identity is Identity.NODE:
            decision = _both(decision, policy.decide(Request(host, caller_id, Category.NODE, caller_id)))
        return decision

    def _parameter(
        self, policy: Policy, caller: Caller, call: Call, arguments: tuple[object, ...], tree: Tree
    ) -> Decision:
        """Everything the call touches: the key, what is below it, and what a value below a value takes the place of."""
        category = Category.READ if call.touches is Touch.READ else Category.WRITE
        host, caller_id = caller.peer.host, caller.caller_id
        key = str(arguments[-1] if category is Category.READ else arguments[0])
        there, in_the_way = standing_at(tree, key)
        value = cast(Value, arguments[1]) if category is Category.WRITE and len(arguments) > 1 else None
        decision = policy.decide_parameter(
            Request(host, caller_id, category, key),
            namespace=holds_others(value) or (holds_others(there) and not call.name.startswith("un")),
        )
        if value is not None and in_the_way is not None and decision.allowed:
            decision = _both(decision, policy.decide(Request(host, caller_id, category, in_the_way)))
        return decision

    # --- the binding of claims ---

    def _late(self, caller: Caller, call: Call, arguments: tuple[object, ...]) -> Decision | None:
        if call.api is None:
            return None
        api = arguments[call.api]
        assert isinstance(api, ApiUri)  # noqa: S101 - the row says so; narrows the type for mypy
        known = self._registry.find(caller.caller_id, caller.peer.host, api.text)
        if known is not None and known.life is Life.REPLACED:
            return _no(
                f"this call is late: the node {known.name} at {api.text} was replaced by another of its name"
            )
        return None

    def _unreachable(self, caller: Caller, call: Call, arguments: tuple[object, ...]) -> Decision | None:
        """A node that listens on its own loopback cannot be called from another host, whatever the policy says."""
        if call.api is None or call.name.startswith("un") or caller.peer.host.is_loopback:
            return None
        api = arguments[call.api]
        assert isinstance(api, ApiUri)  # noqa: S101 - the row says so; narrows the type for mypy
        if not _is_loopback(api.uri.host):
            return None
        return _no(
            f"{caller.caller_id} listens on its own machine's loopback only ({api.text[:80]}): nobody else can "
            f"call it; start it with ROS_IP={caller.peer.text}, or without ROS_IP and ROS_HOSTNAME"
        )

    def _bound(self, caller: Caller, call: Call, decision: Decision) -> Decision | Contest:
        holder = self._registry.holder(caller.caller_id)
        if holder is None:
            return decision
        if holder.own:  # without isolation the robot's nodes have its address
            return _no(f"the name {holder.name} belongs to the appliance")
        if holder.host == caller.peer.host:
            return decision
        if call.identity is Identity.NODE and call.name.startswith("register"):
            if self._policy().takeover == "granted":
                return decision
            return Contest(holder, decision)
        return _no(f"{caller.caller_id} is held by {holder.host}; {caller.peer.host} cannot speak for it")

    def _is_own_subscriber(self, caller: Caller, call: Call, arguments: tuple[object, ...]) -> bool:
        """Whether a node of the appliance asks another node, at its outer face, for a topic that it subscribed to.

        RVMaster has a listener for the appliance's own nodes, the faces have not.
        """
        if caller.target is None or call.category is not Category.SUBSCRIBE or not caller.peer.here:
            return False
        holder = self._registry.holder(caller.caller_id)
        return holder is not None and holder.own and (Kind.SUBSCRIPTION, arguments[0]) in holder.registrations

    # --- limits ---

    def _over_limit(self, caller: Caller, call: Call, arguments: tuple[object, ...]) -> Decision | None:
        if call.api is None or call.name.startswith("un"):
            return None
        host = caller.peer.host
        if self._registry.registrations_of(host) >= self._limits.registrations:
            return _no(f"{host} has {self._limits.registrations} registrations, the limit for one host")
        api = arguments[call.api]
        assert isinstance(api, ApiUri)  # noqa: S101 - the row says so; narrows the type for mypy
        if self._is_one_too_many(caller, api) and self._registry.spare_of(host) is None:
            return _no(f"{host} has {self._limits.nodes} nodes, the limit for one host")
        return None

    def to_make_room(self, caller: Caller, api: ApiUri) -> Incarnation | None:
        """The node of the caller's host that is gone and goes for good, so that a new one has room."""
        return self._registry.spare_of(caller.peer.host) if self._is_one_too_many(caller, api) else None

    def _is_one_too_many(self, caller: Caller, api: ApiUri) -> bool:
        host = caller.peer.host
        return (
            self._registry.nodes_of(host) >= self._limits.nodes
            and self._registry.find(caller.caller_id, host, api.text) is None
        )


def contested(contest: Contest, gone: bool) -> Decision:
    """The decision of a contest, once it is known whether the holder's node is gone."""
    if gone:
        return contest.decision
    return _no(
        f"{contest.holder.name} is held by a running node on {contest.holder.host}; another host may take the name "
        "over once that node is gone (or at once with [Options] takeover = granted)"
    )


def _is_loopback(host: str) -> bool:
    if host.lower() in ("localhost", "localhost.localdomain", "ip6-localhost"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _both(first: Decision, second: Decision) -> Decision:
    """Both must allow; the one that denies (or would) is the answer, else the first."""
    return second if not second.allowed or (second.would_deny and not first.would_deny) else first


def _no(reason: str) -> Decision:
    return Decision(False, None, reason)


def _node_request(request: Request) -> Request:
    return Request(request.host, request.caller_id, Category.NODE, request.caller_id)
