"""The context of a function during compilation: its variables by name, and the statements written so far."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from rosmop.check.assignables import Value, Variable
from rosmop.form import nodes
from rosmop.form.compiled import Comparison, Given, Publication
from rosmop.form.findings import Diagnostic, Position, SpecificationError
from rosmop.form.sites import Site, SiteVariable, Symbols
from rosmop.runtime.values import ValueCodec
from rosmop.text import tree
from rosmop.text.foreign import instead
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes, nearest, quote
from rosmop.types.value_types import Type

Role = Literal["action", "timer", "handler", "init", "function"]
ValueOf = Callable[["FunctionScope", tree.Expression], Value]


@dataclass(eq=False)
class HelperFunction:
    """A helper function; `references` are the parameters whose new values it returns.

    `names` are the other variables that it, or a function that it calls, reads or assigns.
    """

    name: str
    code: str
    result: Type
    parameters: tuple[Variable, ...]
    references: tuple[Variable, ...]
    node: tree.FunctionDefinition
    recursive: bool = False
    names: frozenset[str] = frozenset()
    changes: frozenset[str] = frozenset()
    calls: frozenset[str] = frozenset()


@dataclass(frozen=True)
class ConstantReference:
    """A shared variable, or a part of it, that is passed to a function as a constant reference."""

    position: Position
    function: str
    parameter: Variable
    variable: Variable


@dataclass(eq=False)
class SpecificationNames:
    name: str
    context: str
    variables: dict[str, Variable] = field(default_factory=dict)
    functions: dict[str, HelperFunction] = field(default_factory=dict)
    parameters: dict[str, Variable] = field(default_factory=dict)
    misdeclared: set[str] = field(default_factory=set)
    """Names with rejected declarations; using them is not reported again."""
    events: dict[str, str] = field(default_factory=dict)
    """The topic of each event with a message."""
    uses: set[str] = field(default_factory=set)
    comparisons: dict[tree.BinaryExpression, Comparison] = field(default_factory=dict)
    lent: list[ConstantReference] = field(default_factory=list)
    givens: dict[str, Given] = field(default_factory=dict)
    safes: dict[str, nodes.SafeMessage] = field(default_factory=dict)
    instances: dict[tuple[object, ...], HelperFunction] = field(default_factory=dict)
    is_library: bool = False

    def changed_by(self, name: str) -> frozenset[str]:
        waiting, seen, found = [name], {name}, frozenset[str]()
        while waiting:
            function = self.functions[waiting.pop()]
            found |= function.changes
            waiting += function.calls - seen
            seen |= function.calls
        return found


@dataclass(eq=False)
class LoopScope:
    """A loop or switch around the current statement. Before a `continue`, `step` sees the names of `blocks`."""

    step: Callable[[], None] | None
    blocks: list[dict[str, Variable]] = field(default_factory=list)
    flag: str | None = None  # for a switch: the flag that is set if the loop around it continues
    continued: bool = False  # for a switch: whether a `continue` in it sets the flag


@dataclass
class StatementList:
    """A list of statements under construction, and the site of the next statement."""

    found: list[nodes.Statement] = field(default_factory=list)
    site: int = -1


class SharedVariables:
    """The variables of the set: `types` by the code's names, `owners` by the names in the text."""

    def __init__(self) -> None:
        self.types: dict[str, Type] = {}
        self.owners: dict[str, list[SpecificationNames]] = {}
        self.unsliced: set[str] = set()

    def declare(self, names: SpecificationNames, variable: Variable) -> None:
        names.variables[variable.name] = variable
        self.types[variable.code] = variable.type
        self.owners.setdefault(variable.name, []).append(names)
        if not variable.sliced:
            self.unsliced.add(variable.code)

    def foreign(
        self, own: SpecificationNames, name: str, position: Position
    ) -> tuple[Variable | None, str | None]:
        owners = [other for other in self.owners.get(name, ()) if other is not own]
        if len(owners) > 1:
            both = " and ".join(other.name for other in owners[:2])
            raise SpecificationError.at(
                position, f"{quote(name)} is a variable of {both}; give one of them another name"
            )
        if not owners:
            return None, None
        variable = owners[0].variables[name]
        if variable.sliced:
            raise SpecificationError.at(
                position, f"each slice of {owners[0].name} has its own {quote(name)}: others cannot see it"
            )
        return variable, owners[0].name


class CompilationContext:
    """The state that all functions share during compilation."""

    def __init__(
        self, messages: MessageTypes, value_of: ValueOf, *, margins: bool = False, lints: bool = True
    ) -> None:
        self.symbols = Symbols()
        self.margins = margins
        self.lints = lints
        self.messages = messages
        self.value_of = value_of
        self.values = ValueCodec(messages)
        self.functions: dict[str, nodes.Function] = {}
        self.specifications: list[SpecificationNames] = []
        self.variables = SharedVariables()
        self.findings: list[Diagnostic] = []
        self.publications: list[Publication] = []
        self.calls: list[Publication] = []
        self.bound: dict[str, Sequence[Any]] = {}
        """The fields that the pattern of each event binds (`PatternField`), by the name of its function."""
        self.partial = False
        """Whether some files of the set could not be parsed. These files may declare names that seem unknown."""

    def define(self, function: nodes.Function) -> None:
        self.functions[function.name] = function


@dataclass
class HandledEvent:
    """The event whose action a function is, as far as it is one; `message_type` is the type of `MESSAGE`.

    `pending` is the code's name for the assigned fields, if `MESSAGE` was read; `drop_refused` is why `DROP;` is not
    allowed.
    """

    message_type: str | None = None
    event: str | None = None
    pending: str | None = None
    drop_refused: str | None = None


@dataclass
class FunctionEffects:
    """Effects of a function: whether it `changes` any variable, the code's names of those that it writes (`written`)
    and of the shared ones that it assigns (`shared`), and the helper functions that it `calls`.
    """

    written: set[str] = field(default_factory=set)
    changes: bool = False
    shared: set[str] = field(default_factory=set)
    calls: set[str] = field(default_factory=set)


class FunctionScope:
    """A function during compilation."""

    def __init__(self, shared: CompilationContext, names: SpecificationNames, role: Role) -> None:
        self.shared = shared
        self.names = names
        self.role: Role = role
        self.lines = StatementList()
        self.result: Type = value_types.VOID
        self.references: tuple[Variable, ...] = ()
        self.handled = HandledEvent()
        self.below: set[str] = set()  # shared variables that are declared later
        self.loops: list[LoopScope] = []
        self.effects = FunctionEffects()
        self.recursive = False
        self.notes = shared.margins and role != "init"  # comparisons are noted
        self.misdeclared: set[str] = set()  # local names with rejected declarations
        self._blocks: list[dict[str, Variable]] = [{}]

    @property
    def symbols(self) -> Symbols:
        return self.shared.symbols

    @property
    def values(self) -> ValueCodec:
        return self.shared.values

    @property
    def messages(self) -> MessageTypes:
        return self.shared.messages

    @property
    def context(self) -> str:
        return self.names.context

    def value_of(self, node: tree.Expression) -> Value:
        return self.shared.value_of(self, node)

    # Names

    @contextmanager
    def block(self) -> Iterator[dict[str, Variable]]:
        names: dict[str, Variable] = {}
        self._blocks.append(names)
        try:
            yield names
        finally:
            self._blocks.pop()

    def enter(self, loop: LoopScope) -> None:
        loop.blocks = self._blocks.copy()
        self.loops.append(loop)

    @contextmanager
    def around(self, loop: LoopScope) -> Iterator[None]:
        inner, self._blocks = self._blocks, loop.blocks
        try:
            yield
        finally:
            self._blocks = inner

    def declare(self, variable: Variable) -> None:
        block = self._blocks[-1]
        if variable.name in block:
            raise SpecificationError.at(
                variable.position, f"{quote(variable.name)} is declared twice in this block"
            )
        block[variable.name] = variable
        if variable.alias is None:
            self.shared.variables.types[variable.code] = variable.type

    def local(self, name: str, kind: Type, position: Position, *, constant: bool = False) -> Variable:
        variable = Variable(name, kind, self.symbols.fresh("v"), position, constant=constant)
        self.declare(variable)
        return variable

    def find(self, name: str, position: Position) -> Variable | None:
        variable, owner = self._find(name, position)
        if owner is not None:
            self.names.uses.add(owner)
        return variable

    def _find(self, name: str, position: Position) -> tuple[Variable | None, str | None]:
        for block in reversed(self._blocks):
            if name in block:
                return block[name], None
        if name in self.below:
            raise SpecificationError.at(position, f"{quote(name)} is declared below; move its declaration up")
        own = self.names.variables.get(name)
        return (own, None) if own is not None else self.shared.variables.foreign(self.names, name, position)

    def changes_anything(self) -> bool:
        effects = self.effects
        return effects.changes or any(self.names.changed_by(called) for called in effects.calls)

    def unknown(self, name: str, position: Position, what: str = "variable") -> SpecificationError:
        wrong = (self.misdeclared, *(other.misdeclared for other in self.shared.specifications))
        if self.shared.partial or any(name in names for names in wrong):
            return SpecificationError(())
        known = [local for block in self._blocks for local in block]
        known += filter(str.isidentifier, [*self.names.variables, *self.names.functions])
        advice = instead(name.split("::"))
        hint = f"; {advice}" if advice else nearest(name, known)
        return SpecificationError.at(position, f"unknown {what} {quote(name)}{hint}")

    def note_publication(self, topic: str, kind: str, position: Position) -> None:
        self.shared.publications.append(Publication(self.names.name, topic, kind, position))

    def note_call(self, service: str, kind: str, position: Position) -> None:
        self.shared.calls.append(Publication(self.names.name, service, kind, position))

    # Statements

    def temporary(self, prefix: str = "t") -> str:
        return self.symbols.fresh(prefix)

    def site(self, node: tree.SyntaxNode) -> int:
        return self.symbols.site(Site(node.position, tuple(self._variables(node))))

    @contextmanager
    def at(self, node: tree.SyntaxNode) -> Iterator[None]:
        """Attribute the statements written in the block to this node."""
        before = self.lines.site
        self.lines.site = self.site(node)
        try:
            yield
        finally:
            self.lines.site = before

    @contextmanager
    def looking(self) -> Iterator[None]:
        before, self.notes = self.notes, False
        try:
            yield
        finally:
            self.notes = before

    def add(self, statement: nodes.Statement) -> None:
        self.lines.found.append(statement)

    def evaluate(self, value: nodes.Expression) -> None:
        self.add(nodes.Evaluate(self.lines.site, value))

    @contextmanager
    def nested(self) -> Iterator[list[nodes.Statement]]:
        outer, self.lines.found = self.lines.found, []
        try:
            yield self.lines.found
        finally:
            self.lines.found = outer

    def function(
        self, name: str, parameters: tuple[str, ...], *, happens: int | None = None, same_as: str = ""
    ) -> nodes.Function:
        shared = tuple(sorted(self.effects.written))
        return nodes.Function(
            name, self.context, parameters, tuple(self.lines.found), shared, happens, same_as
        )

    def _variables(self, node: tree.SyntaxNode) -> Iterator[SiteVariable]:
        seen: set[str] = set()
        for name in names_in(node):
            if name in seen or len(seen) >= 16:
                continue
            seen.add(name)
            try:
                variable, _ = self._find(name, node.position)
            except SpecificationError:
                continue
            if variable is not None and variable.alias is None:
                steady = value_types.is_scalar(variable.type) or isinstance(
                    variable.type, value_types.StringType
                )
                yield SiteVariable(name, variable.code, variable.type, steady)


def names_in(node: object) -> Iterator[str]:
    waiting = [node]
    while waiting:
        current = waiting.pop()
        if isinstance(current, tree.Name):
            if len(current.parts) == 1:
                yield current.parts[0]
        elif isinstance(current, tuple):
            waiting += current
        elif isinstance(current, tree.SyntaxNode) and (
            current is node or not isinstance(current, tree.Statement)
        ):
            waiting += reversed(tree.fields_of(current))
