"""Explain a decision: the deciding rule, the words by which it includes the host, and the overruled rules."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from appliance.policy import commands
from appliance.policy.model import Category, Decision, Request, Rule, text_for_caller
from appliance.policy.policy import CompiledRule, Policy
from appliance.policy.rate_limits import NO_LIMIT, LimitScope
from appliance.policy.rights import Right, decide_right, rights_of
from appliance.policy.sections import PARAMETERS

_VERDICTS = {
    "allow": "allowed",
    "deny": "denied",
    "ask": "needs an approval",
    "would deny": "would be denied (audit-only: passes)",
}


@dataclass(frozen=True, slots=True)
class OverruledRule:
    """A rule that matches the resource but does not decide. `grants`: it would grant the request."""

    rule: Rule
    grants: bool
    why: str


@dataclass(frozen=True, slots=True)
class DecisionExplanation:
    """The decision on one category of a request.

    `through` lists the words of the deciding rule that include the host, `lost` the overruled rules, `also` the other
    rights that the request needs. `namespace` is the denial that an allowed parameter gets if it contains other
    parameters at the time of the call.
    """

    request: Request
    decision: Decision
    through: tuple[str, ...]
    lost: tuple[OverruledRule, ...]
    also: "tuple[DecisionExplanation, ...]" = ()
    namespace: Decision | None = None
    told: str | None = None
    limit: str = ""
    """The limit of the request, with its line in `[Limits]`."""
    blocked: bool = False
    carried: str = ""
    """Whether `[Authority]` lets the messages of an allowed publisher through now; empty if no group has its topic."""

    @property
    def allowed(self) -> bool:
        return self.together == "allow"

    @property
    def together(self) -> str:
        verdicts = {each.decision.verdict for each in (self, *self.also)}
        return "deny" if "deny" in verdicts else "ask" if "ask" in verdicts else "allow"

    @property
    def node(self) -> "DecisionExplanation | None":
        return self._also(Category.NODE)

    @property
    def command(self) -> "DecisionExplanation | None":
        return self._also(Category.COMMAND)

    def _also(self, category: Category) -> "DecisionExplanation | None":
        return next((other for other in self.also if other.request.category is category), None)


def explain(policy: Policy, request: Request) -> DecisionExplanation:
    first, *others = (_explain(policy, right) for right in rights_of(request))
    return replace(first, also=tuple(others))


def _explain(policy: Policy, right: Right) -> DecisionExplanation:
    request = right.request
    parameter = request.category in PARAMETERS
    decision = decide_right(policy, right)
    atoms = policy.atoms_of(request.host)
    blocked = policy.block_of(request.host) is not None
    matching = [] if blocked else _matching(policy, request)
    winner = next((rule for rule in matching if rule.rule == decision.rule), None)
    through = winner.granted_through(atoms) if winner is not None else ()
    lost = tuple(
        OverruledRule(rule.rule, rule.grants(atoms), _why(rule, decision))
        for rule in matching
        if rule is not winner
    )
    namespace = policy.decide_parameter(request, namespace=True) if parameter and decision.allowed else None
    if namespace is not None and namespace.allowed:
        namespace = None
    told = None if decision.allowed or decision.asks else text_for_caller(decision, policy.tell)
    limit = _limit(policy, request) if decision.allowed else ""
    carried = _carried(policy, request) if decision.allowed else ""
    return DecisionExplanation(request, decision, through, lost, (), namespace, told, limit, blocked, carried)


def render(explanation: DecisionExplanation) -> Iterator[str]:
    yield from _render_one(explanation)
    if explanation.blocked:
        return
    for other in explanation.also:
        if other.request.category is Category.NODE:
            yield "and the node rule, because this call makes a node part of the graph:"
        else:
            yield f"and the rule for {other.request.resource}, the call that does it:"
        yield from ("  " + line for line in _render_one(other))
    if explanation.also:
        yield f"together: {_VERDICTS[explanation.together]}"
    if explanation.carried:
        yield explanation.carried


def _render_one(explanation: DecisionExplanation) -> Iterator[str]:
    decision = explanation.decision
    yield f"{_VERDICTS[decision.verdict]}: {decision.reason}"
    if decision.asks is not None:
        yield "  an operator approves it with `rosrv approve`, each time or for some time"
    if not explanation.blocked:
        yield f"  rule: {decision.rule or 'no rule'}"
    if explanation.told is not None:
        yield f"  answer to the host: {explanation.told}"
    if explanation.through:
        yield f"  the host is in: {', '.join(explanation.through)}"
    if explanation.limit:
        yield f"  limit: {explanation.limit}"
    if explanation.namespace is not None:
        yield f"  but denied if it has parameters below it: {explanation.namespace.reason}"
    for lost in explanation.lost:
        yield f"  overruled: {lost.rule}, which would {'allow' if lost.grants else 'deny'}: {lost.why}"


def _carried(policy: Policy, request: Request) -> str:
    group = policy.command_group(request.resource) if request.category is Category.PUBLISH else None
    if group is None:
        return ""
    if group.ranks:
        return f"its messages are carried while it moves and no higher rank does: rosrv drive status {group.name}"
    if policy.holders is None:
        return f"its messages are carried only while it holds {group.name}"
    if policy.may_command(request.resource, request.host):
        return f"its messages are carried now: it holds {group.name}"
    holder = policy.holder(group)
    order = group.order(request.host, policy.atoms_of(request.host), holder)
    why = f"{holder or 'no host'} holds {group.name}: {order}"
    return f"but none of its messages is carried now, because {why}"


def _limit(policy: Policy, request: Request) -> str:
    rule, rate = policy.limit_rule(request.resource), policy.limit_on(request)
    publishes = request.category is Category.PUBLISH
    together = policy.limit(LimitScope.TOPIC, request.resource) if publishes else NO_LIMIT
    parts = [f"{rate} for all its nodes together" if publishes else str(rate)] if rate else []
    if together:
        parts.append(f"{together} for all publishers together, in equal parts for hosts that want more")
    return f"{'; '.join(parts)}, by {rule.rule}" if rule is not None and parts else ""


def _matching(policy: Policy, request: Request) -> list[CompiledRule]:
    command = request.category is Category.COMMAND
    name = commands.ALIASES.get(request.resource, request.resource) if command else request.resource
    rules = policy.rules(request.category)
    keyed = [(rule.key.specificity, rule) for rule in rules if rule.key and rule.key.matches(name)]
    keyed.sort(key=lambda pair: pair[0], reverse=True)
    return [rule for _, rule in keyed] + [rule for rule in rules if rule.key is None]


def _why(rule: CompiledRule, decision: Decision) -> str:
    if decision.rule is None:
        return "this request is decided without a rule"
    if rule.key is None:
        return "default is for what no key matches"
    if rule.rule.key == decision.rule.key:
        return "another rule decides"
    return f"{decision.rule.key} is more specific"
