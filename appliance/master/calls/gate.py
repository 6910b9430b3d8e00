"""Decide calls: first by the policy, then by the limits per host and the binding of names to hosts."""

import ipaddress
import math
from collections.abc import Callable
from dataclasses import dataclass

from appliance.base.counted import counted
from appliance.master.calls.call import ApiUri, Attempt, Caller, CallVerb
from appliance.master.graph.registry import HostFullError, Incarnation, Kind, Life, Registry
from appliance.master.graph.revocation import OWN, OWN_PARAMETERS, rosout_may_have
from appliance.master.reconcile.liveness import Presence, Probe
from appliance.policy.model import Address, Category, Decision
from appliance.policy.policy import Policy
from appliance.policy.policy_settings import AT_ONCE
from appliance.policy.rights import decide, rights_of_call
from appliance.quotas.table import NAMES
from roswire.names import ROSOUT
from roswire.parameter_tree import Tree

_TIMES_THE_REST = 3


@dataclass(frozen=True, slots=True)
class NameConflict:
    """Another host holds the name. `decision` is valid only if the node `holder` is gone."""

    holder: Incarnation
    decision: Decision


@dataclass(frozen=True, slots=True)
class HostLimits:
    """The most registrations of one host, and of all hosts together."""

    registrations: int = NAMES.bounds.host
    registrations_in_all: int = NAMES.bounds.whole


class CallGate:
    """Decides calls, without side effects. `decide_contest` decides a `NameConflict` by a probe of the holder."""

    def __init__(self, policy: Callable[[], Policy], registry: Registry, limits: HostLimits) -> None:
        self._policy = policy
        self._registry = registry
        self._limits = limits

    def decide(self, attempt: Attempt, tree: Tree) -> Decision | NameConflict:
        caller, call = attempt.caller, attempt.call
        if caller.own:
            return _of_own_node(attempt)
        asks = caller.target is not None and call.row.category is Category.SUBSCRIBE
        if asks and self.is_own_subscriber(caller, attempt.resource):
            return Decision(True, None, OWN)
        rights = rights_of_call(
            attempt.request, call.policy_name, attempt.resource or None, value=attempt.value, tree=tree
        )
        decision = decide(self._policy(), rights)
        if not decision.allowed or call.row.wire or not caller.caller_id:
            return decision
        denial = None
        if attempt.api is not None and call.verb is not CallVerb.UNREGISTER:
            denial = (
                self._late(caller, attempt.api)
                or self._taken(attempt)
                or _unreachable(caller, attempt.api)
                or self._over_limit(caller, attempt.api)
            )
        return denial or self._bound(attempt, decision)

    # --- the binding of claims ---

    def _late(self, caller: Caller, api: ApiUri) -> Decision | None:
        known = self._registry.find(caller.caller_id, caller.peer.host, api.text)
        if known is not None and known.life is Life.REPLACED:
            return _no(
                f"this call is late: the node {known.name} at {api.text} was replaced by another node of its name"
            )
        return None

    def _bound(self, attempt: Attempt, decision: Decision) -> Decision | NameConflict:
        caller, call = attempt.caller, attempt.call
        holder = self._registry.holder(caller.caller_id)
        if holder is None:
            return decision
        if holder.own:  # without isolation, the robot's nodes have the same address as the appliance
            return _no(f"the name {holder.name} belongs to the appliance")
        if holder.host == caller.peer.host:
            return decision
        if call.verb is CallVerb.REGISTER and call.kind is not Kind.PARAMETER:
            if self._policy().takeover == "granted":
                return decision
            return NameConflict(holder, decision)
        held, other = f"{caller.caller_id} is held by", f"{caller.peer.host} cannot speak for it"
        return _no(f"{held} {holder.host}; {other}", told=f"{held} a node of another host; {other}")

    def _taken(self, attempt: Attempt) -> Decision | None:
        if attempt.call.kind is Kind.SERVICE:
            for provider in self._registry.registrants(Kind.SERVICE, attempt.resource):
                if provider.of_monitors:
                    return _no(f"the service {attempt.resource} belongs to the appliance")
        return None

    def is_own_subscriber(self, caller: Caller, topic: str) -> bool:
        """Return whether an own node calls a proxy endpoint for a topic to which it is subscribed.

        Proxy endpoints have no separate listener for own nodes.
        """
        holder = self._registry.holder(caller.caller_id) if caller.peer.here else None
        return holder is not None and holder.own and (Kind.SUBSCRIPTION, topic) in holder.registrations

    # --- limits ---

    def _over_limit(self, caller: Caller, api: ApiUri) -> Decision | None:
        host = caller.peer.host
        if self._registry.registrations_of(host) >= self._limits.registrations:
            return _no(
                f"{host} has {self._limits.registrations} registrations, the limit for one host: raise"
                " limits.topics_per_host"
            )
        denial = self._too_many_names(host)
        if denial is not None:
            return denial
        try:
            self._registry.room_for(caller.caller_id, host, api.text)
        except HostFullError as error:
            return _no(str(error))
        return None

    def _too_many_names(self, host: Address) -> Decision | None:
        """Deny a host with too many registrations; hosts that the policy names as one network count as one."""
        registrations = self._registry.registrations
        left = max(0, self._limits.registrations_in_all - registrations)
        if registrations < _TIMES_THE_REST * left:
            return None  # no host can have too many
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
            f"{who} has {counted(mine, 'registration')}, and {left} are left for all other hosts: a host may have"
            f" {_TIMES_THE_REST} times as many as are left"
        )


def _of_own_node(attempt: Attempt) -> Decision:
    caller_id, call = attempt.caller.caller_id, attempt.call
    known = False
    if caller_id != ROSOUT:
        what = f"speak as {caller_id[:80] or 'an unnamed node'}"
    elif call.verb in {CallVerb.REGISTER, CallVerb.UNREGISTER} and call.kind is not None:
        known = rosout_may_have(call.kind, attempt.resource)
        what = f"have the {call.kind} {attempt.resource}"
    elif call.verb is CallVerb.READ and attempt.resource:
        known = attempt.resource in OWN_PARAMETERS
        what = f"read the parameter {attempt.resource}"
    else:
        what = f"call {call.name}"
    return Decision(known, None, OWN if known else f"{ROSOUT} is {OWN} and may not {what}")


def _unreachable(caller: Caller, api: ApiUri) -> Decision | None:
    """Deny a loopback URI from another machine, because other hosts could not call the node."""
    if caller.peer.host.is_loopback or not _is_loopback(api.uri.host):
        return None
    return _no(
        f"{caller.caller_id} listens on its own machine's loopback only ({api.text[:80]}): no other host can "
        f"call it; start it with ROS_IP={caller.peer.text}, or without ROS_IP and ROS_HOSTNAME"
    )


def decide_contest(contest: NameConflict, probe: Probe | None) -> Decision:
    """Return the decision on a contested name: denied unless a probe of this holder found that it is gone."""
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
    return Decision(False, None, reason, told=told)
