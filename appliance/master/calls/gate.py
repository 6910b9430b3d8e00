"""The one decision point: the policy first, then the binding of claims to hosts, then the limits per host.

`Gate.decide` is a function of the running policy, the registry and the parameters; it forwards nothing and records
nothing. A question that only the network can answer (is the node that holds this name still there?) is returned as
`Contest`, and asked again with the answer.
"""

import ipaddress
import math
from collections.abc import Callable
from dataclasses import dataclass

from appliance.master.caller import ApiUri, Caller
from appliance.master.calls.call import Attempt, Identity, Verb
from appliance.master.graph.own_node import OWN, ROSOUT
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry
from appliance.master.reconcile.liveness import Presence, Probe
from appliance.policy.model import Address, Category, Decision
from appliance.policy.policy import Policy
from appliance.policy.policy_settings import AT_ONCE
from appliance.policy.rights import decide, rights_of_call
from appliance.quotas.table import NAMES
from roswire.parameter_tree import Tree

_TIMES_THE_REST = 3


@dataclass(frozen=True, slots=True)
class Contest:
    """Another host holds the name; the call is granted only if its node is gone. `decision` is then the answer."""

    holder: Incarnation
    decision: Decision


@dataclass(frozen=True, slots=True)
class HostLimits:
    """How much of the registry one host may take."""

    nodes: int = 500
    registrations: int = NAMES.bounds.host
    registrations_in_all: int = NAMES.bounds.whole


class Gate:
    """Decides calls by the policy that `policy()` returns at that moment."""

    def __init__(self, policy: Callable[[], Policy], registry: Registry, limits: HostLimits) -> None:
        self._policy = policy
        self._registry = registry
        self._limits = limits

    def decide(self, attempt: Attempt, tree: Tree) -> Decision | Contest:
        """Whether the caller may make this call, while `tree` are the parameters."""
        caller, call = attempt.caller, attempt.call
        if caller.own:
            return _of_own_node(attempt)
        asks = caller.target is not None and call.category is Category.SUBSCRIBE
        if asks and self.is_own_subscriber(caller, attempt.resource):
            return Decision(True, None, OWN)
        rights = rights_of_call(
            attempt.request, call.policy_name, attempt.resource or None, value=attempt.value, tree=tree
        )
        decision = decide(self._policy(), rights)
        if not decision.allowed or call.identity is Identity.NOBODY or not caller.caller_id:
            return decision
        denial = None
        if attempt.api is not None:
            denial = self._late(caller, attempt.api)
            if denial is None and call.verb is not Verb.UNREGISTER:
                denial = (
                    self._taken(attempt)
                    or _unreachable(caller, attempt.api)
                    or self._over_limit(caller, attempt.api)
                )
        return denial or self._bound(attempt, decision)

    # --- the binding of claims ---

    def _late(self, caller: Caller, api: ApiUri) -> Decision | None:
        known = self._registry.find(caller.caller_id, caller.peer.host, api.text)
        if known is not None and known.life is Life.REPLACED:
            return _no(
                f"this call is late: the node {known.name} at {api.text} was replaced by another of its name"
            )
        return None

    def _bound(self, attempt: Attempt, decision: Decision) -> Decision | Contest:
        caller, call = attempt.caller, attempt.call
        holder = self._registry.holder(caller.caller_id)
        if holder is None:
            return decision
        if holder.own:  # without isolation the robot's nodes have its address
            return _no(f"the name {holder.name} belongs to the appliance")
        if holder.host == caller.peer.host:
            return decision
        if call.verb is Verb.REGISTER and call.kind is not Kind.PARAMETER:
            if self._policy().takeover == "granted":
                return decision
            return Contest(holder, decision)
        held, other = f"{caller.caller_id} is held by", f"{caller.peer.host} cannot speak for it"
        return _no(f"{held} {holder.host}; {other}", told=f"{held} a node of another host; {other}")

    def _taken(self, attempt: Attempt) -> Decision | None:
        """A service has one provider, the last who registers it; what the appliance offers nobody takes from it."""
        if attempt.call.kind is Kind.SERVICE:
            for provider in self._registry.registered(Kind.SERVICE, attempt.resource):
                if provider.of_monitors:
                    return _no(f"the service {attempt.resource} belongs to the appliance")
        return None

    def is_own_subscriber(self, caller: Caller, topic: str) -> bool:
        """Whether a node of the appliance calls another node, at its outer face, for a topic that it subscribed to.

        RVMaster has a listener for the appliance's own nodes, the faces have not.
        """
        holder = self._registry.holder(caller.caller_id) if caller.peer.here else None
        return holder is not None and holder.own and (Kind.SUBSCRIPTION, topic) in holder.registrations

    # --- limits ---

    def _over_limit(self, caller: Caller, api: ApiUri) -> Decision | None:
        host = caller.peer.host
        if self._registry.registrations_of(host) >= self._limits.registrations:
            return _no(f"{host} has {self._limits.registrations} registrations, the limit for one host")
        denial = self._too_many_names(host)
        if denial is not None:
            return denial
        if self._is_one_too_many(caller, api) and self._registry.spare_of(host) is None:
            return _no(f"{host} has {self._limits.nodes} nodes, the limit for one host")
        return None

    def _too_many_names(self, host: Address) -> Decision | None:
        """Hosts that the policy names as one network count as one: nobody gains by many addresses."""
        left = max(0, self._limits.registrations_in_all - self._registry.registrations)
        if self._registry.registrations < _TIMES_THE_REST * left:
            return None  # nobody has so many
        policy = self._policy()
        named = policy.named_as(host)
        mine = sum(
            count
            for other, count in self._registry.registrations_by_host()
            if policy.named_as(other) == named
        )
        if mine < _TIMES_THE_REST * left:
            return None
        who = named if named.num_addresses > 1 else host
        return _no(
            f"{who} has {mine} registrations, and {left} are left for all other hosts: a host may have"
            f" {_TIMES_THE_REST} times as many as are left"
        )

    def to_make_room(self, caller: Caller, api: ApiUri) -> Incarnation | None:
        """The node of the caller's host that is gone and goes for good, so that a new one has room."""
        return self._registry.spare_of(caller.peer.host) if self._is_one_too_many(caller, api) else None

    def _is_one_too_many(self, caller: Caller, api: ApiUri) -> bool:
        host = caller.peer.host
        return (
            self._registry.nodes_of(host) >= self._limits.nodes
            and self._registry.find(caller.caller_id, host, api.text) is None
        )


def _of_own_node(attempt: Attempt) -> Decision:
    """The appliance's own node has the rights that are written at it, whatever the policy says."""
    caller_id, call = attempt.caller.caller_id, attempt.call
    known = False
    if caller_id != ROSOUT.name:
        what = f"speak as {caller_id[:80] or 'nobody'}"
    elif call.verb in {Verb.REGISTER, Verb.UNREGISTER} and call.kind is not None:
        known = ROSOUT.may_have(call.kind, attempt.resource)
        what = f"have the {call.kind} {attempt.resource}"
    elif call.verb is Verb.READ and attempt.resource:
        known = attempt.resource in ROSOUT.parameters
        what = f"read the parameter {attempt.resource}"
    else:
        what = f"call {call.name}"
    return Decision(known, None, OWN if known else f"{ROSOUT.name} is {OWN} and may not {what}")


def _unreachable(caller: Caller, api: ApiUri) -> Decision | None:
    """A node that listens on its own loopback cannot be called from another host, whatever the policy says."""
    if caller.peer.host.is_loopback or not _is_loopback(api.uri.host):
        return None
    return _no(
        f"{caller.caller_id} listens on its own machine's loopback only ({api.text[:80]}): nobody else can "
        f"call it; start it with ROS_IP={caller.peer.text}, or without ROS_IP and ROS_HOSTNAME"
    )


def contested(contest: Contest, probe: Probe | None) -> Decision:
    """The decision of a contest, once the holder's node was probed; not, when another has come to hold the name."""
    holder = contest.holder
    if probe is not None and probe.holder is holder:
        if probe.presence is Presence.GONE:
            return contest.decision
        if probe.presence is Presence.SILENT:
            return _held_by(
                holder,
                "a node",
                " that takes connections and does not answer (it "
                f"hangs, or was stopped); unless it answers it is unregistered in {math.ceil(probe.patience)} s: "
                f"start this node again then (or at once with {AT_ONCE})",
            )
    return _held_by(
        holder,
        "a running node",
        f"; another host may take the name over once that node is gone (or at once with {AT_ONCE})",
    )


def _held_by(holder: Incarnation, what: str, rest: str) -> Decision:
    return _no(
        f"{holder.name} is held by {what} on {holder.host}{rest}",
        told=f"{holder.name} is held by {what} of another host{rest}",
    )


def _is_loopback(host: str) -> bool:
    if host.lower() in ("localhost", "localhost.localdomain", "ip6-localhost"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _no(reason: str, told: str | None = None) -> Decision:
    """A denial by no rule; `told` where the reason names another host."""
    return Decision(False, None, reason, told=told)
