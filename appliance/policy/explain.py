"""Why a request is decided as it is: the rule that decides, how it means the host, the rules that lost."""

from collections.abc import Iterator
from dataclasses import dataclass

from appliance.policy import commands
from appliance.policy.model import Category, Decision, Request, Rule
from appliance.policy.policy import CompiledRule, Policy, needs_node_rule, node_request
from appliance.policy.sections import PARAMETERS


@dataclass(frozen=True, slots=True)
class LostRule:
    """A rule that matches the resource and does not decide, and why; `grants` is what it would have said."""

    rule: Rule
    grants: bool
    why: str


@dataclass(frozen=True, slots=True)
class Explanation:
    """The decision on one category of a request.

    `through` are the words of the deciding rule's value that mean the host (empty for a denial). `node`
    explains the `[Nodes]` right where the call needs that too; `allowed` is the answer to the whole call.
    `namespace` is the denial of a parameter that is allowed, should it hold other parameters: that is known when
    the call comes.
    """

    request: Request
    decision: Decision
    through: tuple[str, ...]
    lost: tuple[LostRule, ...]
    node: "Explanation | None" = None
    namespace: Decision | None = None

    @property
    def allowed(self) -> bool:
        """Whether the whole call passes."""
        return self.decision.allowed and (self.node is None or self.node.allowed)


def explain(policy: Policy, request: Request) -> Explanation:
    """Explain `policy.decide_with_node(request)`; the name must be resolved, as for `decide`."""
    parameter = request.category in PARAMETERS
    decision = policy.decide_parameter(request) if parameter else policy.decide(request)
    atoms = policy.atoms_of(request.host)
    matching = _matching(policy, request)
    winner = next((rule for rule in matching if rule.rule == decision.rule), None)
    through = winner.granted_through(atoms) if winner is not None else ()
    lost = tuple(
        LostRule(rule.rule, rule.grants(atoms), _why(rule, decision))
        for rule in matching
        if rule is not winner
    )
    node = explain(policy, node_request(request)) if needs_node_rule(request) else None
    namespace = policy.decide_parameter(request, namespace=True) if parameter and decision.allowed else None
    if namespace is not None and namespace.allowed:
        namespace = None
    return Explanation(request, decision, through, lost, node, namespace)


def render(explanation: Explanation) -> Iterator[str]:
    """The explanation as lines of text for a person."""
    yield from _render_one(explanation)
    node = explanation.node
    if node is not None:
        yield "and the node rule, because this call makes a node part of the graph:"
        yield from ("  " + line for line in _render_one(node))
        yield f"together: {'allowed' if explanation.allowed else 'denied'}"


def _render_one(explanation: Explanation) -> Iterator[str]:
    decision = explanation.decision
    verdict = "allowed" if decision.allowed else "denied"
    yield f"{'would be denied (audit-only: passes)' if decision.would_deny else verdict}: {decision.reason}"
    yield f"  rule: {decision.rule or 'no rule'}"
    if explanation.through:
        yield f"  the host is in: {', '.join(explanation.through)}"
    if explanation.namespace is not None:
        yield f"  but denied while it is a namespace: {explanation.namespace.reason}"
    for lost in explanation.lost:
        yield f"  lost: {lost.rule}, which would {'allow' if lost.grants else 'deny'}: {lost.why}"


def _matching(policy: Policy, request: Request) -> list[CompiledRule]:
    """Every rule that speaks of the resource, the most specific first, `default` last."""
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
