"""The work that a flow analysis may do, and what blocks and functions of a specification can have as effects."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from rosmop.check.abstract_values import AbstractValue, Places, is_shared
from rosmop.form import nodes

MAX_WORK = 40_000
"""The most statements that are followed in a specification: less than a second."""

MAX_WORK_OF_SET = 10 * MAX_WORK


class FlowLimitError(Exception):
    """There is too much to follow."""


class PureCall(NamedTuple):
    """The result of a call of a function without effects, and what the call adds to the analysis and its state."""

    result: AbstractValue
    skipped: Places
    spoke: bool
    compared: frozenset[str]
    operations: frozenset[int]


@dataclass
class FlowWork:
    """The rest of the work for a specification, and what is known of its functions, calls and blocks."""

    left: int = MAX_WORK
    functions: dict[str, "FunctionFacts"] = field(default_factory=dict)
    own: dict[str, "FunctionFacts"] = field(default_factory=dict)
    calls: dict[Hashable, PureCall] = field(default_factory=dict)
    facts: dict[int, "BlockFacts"] = field(default_factory=dict)
    others: dict[tuple[int, bool], Sequence[nodes.Statement]] = field(default_factory=dict)

    def facts_of(self, body: Sequence[nodes.Statement]) -> "BlockFacts":
        """Return the possible effects of a block of the form, which the caller keeps: its identity is the key."""
        found = self.facts.get(id(body))
        if found is None:
            found = self.facts[id(body)] = _facts_of(body)
        return found

    def facts_of_function(
        self, function: nodes.Function, functions: Mapping[str, nodes.Function]
    ) -> "FunctionFacts":
        """Return the facts of a function together with all functions that it calls."""
        found = self.functions.get(function.name)
        if found is None:
            own, waiting = dict[str, FunctionFacts](), [function.name]
            while waiting:
                name = waiting.pop()
                if name in functions and name not in own:
                    if name not in self.own:
                        self.own[name] = _own_facts(functions[name])
                    own[name] = self.own[name]
                    waiting += own[name].calls
            found = self.functions[function.name] = FunctionFacts(
                frozenset[str]().union(*(one.shared for one in own.values())),
                frozenset[int]().union(*(one.sites for one in own.values())),
                frozenset(own),
                all(one.pure for one in own.values()),
            )
        return found

    def spend(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise FlowLimitError


@dataclass(frozen=True)
class BlockFacts:
    """The effects that a block may have; `stops` are the topics that it stops, with None if it drops the message."""

    stops: frozenset[str | None]
    leaves: bool
    assigned: Sequence[tuple[str, nodes.Expression]]
    flags: frozenset[str]
    puts: Sequence[nodes.Call]

    @property
    def drops(self) -> bool:
        return bool(self.stops)

    def acts(self, fields: Mapping[str, str]) -> bool:
        return self.drops or not self.flags.isdisjoint(fields)


@dataclass(frozen=True)
class FunctionFacts:
    """The shared variables that a function names, its sites and calls.

    It is `pure` if it changes only variables of its own, and is not recursive.
    """

    shared: frozenset[str]
    sites: frozenset[int]
    calls: frozenset[str]
    pure: bool


_EFFECTS = (
    nodes.Leave | nodes.Drop | nodes.StopMessage | nodes.Publish | nodes.Require | nodes.WriteBack
    | nodes.ReadNumbers | nodes.ReadValue
)  # fmt: skip


def _own_facts(function: nodes.Function) -> FunctionFacts:
    changed, read, calls, pure = {*function.parameters}, set[str](), set[str](), True
    for node in nodes.walk(function.body):
        match node:
            case nodes.Read(name=name):
                read.add(name)
            case nodes.Assign(name=name) | nodes.Select(name=name) | nodes.ForEach(name=name):
                changed.add(name)
            case nodes.Call(function="a_put" | "a_slot" | "l_append", arguments=(base, *_)):
                changed |= {one.name for one in nodes.walk(base) if isinstance(one, nodes.Read)}
            case nodes.Invoke(function=called, depth=depth):
                pure = pure and depth is None
                calls.add(called)
        pure = pure and not isinstance(node, _EFFECTS)
    pure = pure and not any(map(is_shared, changed)) and all(map(is_shared, read - changed))
    shared = frozenset(filter(is_shared, changed | read))
    return FunctionFacts(shared, frozenset(nodes.sites_of(function.body)), frozenset(calls), pure)


def _facts_of(body: Sequence[nodes.Statement]) -> BlockFacts:
    inside = [*nodes.walk(tuple(body))]
    stops = {safe.topic for node in inside if isinstance(node, nodes.StopMessage) for safe in node.safes}
    dropped = {None} if any(isinstance(node, nodes.Drop) for node in inside) else set[None]()
    assigned = [(node.name, node.value) for node in inside if isinstance(node, nodes.Assign)]
    kinds = nodes.Leave | nodes.Return | nodes.Break | nodes.Continue
    return BlockFacts(
        frozenset({*stops, *dropped}),
        any(isinstance(node, kinds) for node in inside),
        assigned,
        frozenset(name for name, _ in assigned),
        [node for node in inside if isinstance(node, nodes.Call) and node.function in ("a_put", "a_slot")],
    )
