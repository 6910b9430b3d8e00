"""The tree of an ``.rv`` file: frozen dataclasses, each with the position of its first character.

Strings are bytes, as in C++. A name is the tuple of its parts, such as `("std", "string")`, and is not
resolved.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

from rosmop.form.findings import Position


@dataclass(frozen=True)
class SyntaxNode:
    position: Position = field(compare=False)


def fields_of(node: SyntaxNode) -> list[Any]:
    return [getattr(node, name) for name in node.__dataclass_fields__]


def cancelling(goals: str) -> str:
    """Return the topic that cancels the goals of an action."""
    return goals.removesuffix("/goal") + "/cancel"


def walk(root: object) -> Iterator[SyntaxNode]:
    waiting = [root]
    while waiting:
        current = waiting.pop()
        if isinstance(current, tuple):
            waiting += current
        elif isinstance(current, SyntaxNode):
            yield current
            waiting += fields_of(current)


# Types


@dataclass(frozen=True)
class TypeName(SyntaxNode):
    """A type as written: `name` is ("unsigned", "int"), ("std", "string"), ("std", "vector"), ("[]",), ("auto",), …

    `element` is the element type of a vector or of an array `T[]`. `pointer` stands for `char *`, `reference`
    for `&`.
    """

    name: tuple[str, ...]
    element: "TypeName | None" = None
    constant: bool = False
    pointer: bool = False
    reference: bool = False
    static: bool = False


@dataclass(frozen=True)
class ParameterDeclaration(SyntaxNode):
    """A parameter of an event or of a helper function."""

    type: TypeName
    name: str


# Expressions


@dataclass(frozen=True)
class Expression(SyntaxNode):
    """An expression."""


@dataclass(frozen=True)
class NumberLiteral(Expression):
    """A number as written, with its suffix."""

    text: str


@dataclass(frozen=True)
class StringLiteral(Expression):
    value: bytes


@dataclass(frozen=True)
class CharacterLiteral(Expression):
    """A character literal, as a signed char."""

    value: int


@dataclass(frozen=True)
class Name(Expression):
    """A variable, constant, function or type: `x`, `std::max`, `true`."""

    parts: tuple[str, ...]


@dataclass(frozen=True)
class UnaryExpression(Expression):
    """`!` `-` `+` `~` in front of an operand."""

    operator: str
    operand: Expression


@dataclass(frozen=True)
class IncrementExpression(Expression):
    """`++` or `--`, before or after its target."""

    operator: str
    target: Expression
    prefix: bool


@dataclass(frozen=True)
class BinaryExpression(Expression):
    """Two operands of a binary operator."""

    operator: str
    left: Expression
    right: Expression


@dataclass(frozen=True)
class Assignment(Expression):
    """`=`, `+=`, …"""

    operator: str
    target: Expression
    value: Expression


@dataclass(frozen=True)
class ConditionalExpression(Expression):
    """`condition ? yes : no`."""

    condition: Expression
    yes: Expression
    no: Expression


@dataclass(frozen=True)
class CommaExpression(Expression):
    """`a, b`: the value is the value of the last expression."""

    items: tuple[Expression, ...]


@dataclass(frozen=True)
class CallExpression(Expression):
    """A call of a function, of a member (the callee is a `MemberAccess`) or of a type."""

    callee: Expression
    arguments: tuple[Expression, ...]


@dataclass(frozen=True)
class IndexExpression(Expression):
    """`base[index]`."""

    base: Expression
    index: Expression


@dataclass(frozen=True)
class MemberAccess(Expression):
    """`base.name`."""

    base: Expression
    name: str


@dataclass(frozen=True)
class CastExpression(Expression):
    """`(int) x`, `static_cast<int>(x)`."""

    type: TypeName
    operand: Expression


@dataclass(frozen=True)
class ConstructorCall(Expression):
    """`int(x)`, `std::vector<double>(3, 0.0)`."""

    type: TypeName
    arguments: tuple[Expression, ...]


@dataclass(frozen=True)
class NewExpression(Expression):
    """`new char[size]`."""

    size: Expression


@dataclass(frozen=True)
class NumericLimit(Expression):
    """`std::numeric_limits<type>::name()`."""

    type: TypeName
    name: str


@dataclass(frozen=True)
class InitializerList(Expression):
    """`{1, 2, 3}`, where a vector is initialised or assigned."""

    items: tuple[Expression, ...]


# Statements


@dataclass(frozen=True)
class Statement(SyntaxNode):
    """A statement."""


@dataclass(frozen=True)
class Declarator(SyntaxNode):
    """One name of a declaration. `size` is from `T name[size]`, `arguments` from `T name(…)`."""

    name: str
    value: Expression | None = None
    arguments: tuple[Expression, ...] | None = None
    size: Expression | None = None
    is_array: bool = False


@dataclass(frozen=True)
class Declaration(Statement):
    """Variables of one type."""

    type: TypeName
    declarators: tuple[Declarator, ...]


@dataclass(frozen=True)
class ExpressionStatement(Statement):
    """An expression that is evaluated for its effect."""

    expression: Expression


@dataclass(frozen=True)
class Block(Statement):
    """`{ … }`."""

    statements: tuple[Statement, ...]


@dataclass(frozen=True)
class IfStatement(Statement):
    """`if (condition) yes else no`."""

    condition: Expression
    yes: Statement
    no: Statement | None


@dataclass(frozen=True)
class WhileStatement(Statement):
    """`while (condition) body`, or with `at_end`, `do body while (condition);`."""

    condition: Expression
    body: Statement
    at_end: bool = False


@dataclass(frozen=True)
class ForStatement(Statement):
    """`for (start; condition; step) body`."""

    start: Statement | None
    condition: Expression | None
    step: Expression | None
    body: Statement


@dataclass(frozen=True)
class RangeForStatement(Statement):
    """`for (type name : values) body`."""

    type: TypeName
    name: str
    values: Expression
    body: Statement


@dataclass(frozen=True)
class SwitchCase(SyntaxNode):
    """The statements after `case value:`, up to the next case. For `default:`, the value is None."""

    value: Expression | None
    statements: tuple[Statement, ...]


@dataclass(frozen=True)
class SwitchStatement(Statement):
    """`switch (value) { case …: … }`."""

    value: Expression
    cases: tuple[SwitchCase, ...]


@dataclass(frozen=True)
class BreakStatement(Statement):
    """`break;`."""


@dataclass(frozen=True)
class ContinueStatement(Statement):
    """`continue;`."""


@dataclass(frozen=True)
class ReturnStatement(Statement):
    """`return value;`. In an action, `return;` drops the message."""

    value: Expression | None


@dataclass(frozen=True)
class DropStatement(Statement):
    """`DROP;`."""


@dataclass(frozen=True)
class StopStatement(Statement):
    """`STOP;`."""


@dataclass(frozen=True)
class ResetStatement(Statement):
    """`__RESET;`."""


@dataclass(frozen=True)
class DeleteStatement(Statement):
    """`delete[] name;`, which has no effect."""

    target: Expression


@dataclass(frozen=True)
class PublishStatement(Statement):
    """`PUBLISH(topic, type, value);`."""

    topic: str
    type: str
    type_position: Position = field(compare=False)
    value: Expression


@dataclass(frozen=True)
class CallStatement(Statement):
    """`CALL(service, type, request);`."""

    service: str
    type: str
    type_position: Position = field(compare=False)
    value: Expression


# Specifications


@dataclass(frozen=True)
class PathStep(SyntaxNode):
    """One field of a path, perhaps with an index."""

    name: str
    index: int | None


@dataclass(frozen=True)
class Binding(SyntaxNode):
    """A field of the pattern, and a variable or a constant."""

    path: tuple[PathStep, ...]
    variable: str | None
    constant: Expression | None
    value_position: Position = field(compare=False)


@dataclass(frozen=True)
class MessageTrigger(SyntaxNode):
    """A message on a topic, or a request or response of a service (`part`)."""

    topic: str
    type: str
    type_position: Position = field(compare=False)
    part: str | None
    pattern: tuple[Binding, ...]
    when: Expression | None


@dataclass(frozen=True)
class TimerTrigger(SyntaxNode):
    """A period; `has_unit` is false if the text lacks its unit."""

    period_ns: int
    has_unit: bool = field(default=True, compare=False)


@dataclass(frozen=True)
class EventDefinition(SyntaxNode):
    """An event. The statements in `after` follow an action that does not drop the message."""

    modifiers: tuple[Name, ...]
    name: str
    parameters: tuple[ParameterDeclaration, ...]
    trigger: MessageTrigger | TimerTrigger
    action: Block
    after: tuple[Statement, ...] = field(default=(), compare=False)


@dataclass(frozen=True)
class FunctionDefinition(SyntaxNode):
    type: TypeName | None
    name: str
    parameters: tuple[ParameterDeclaration, ...]
    body: Block


@dataclass(frozen=True)
class InitBlock(SyntaxNode):
    """`init() { … }`."""

    body: Block


@dataclass(frozen=True)
class Handler(SyntaxNode):
    """`@category { … }`."""

    category: str
    body: Block


@dataclass(frozen=True)
class Property(SyntaxNode):
    """A formula of a logic, and its handlers."""

    logic: str
    formula: str
    formula_position: Position = field(compare=False)
    handlers: tuple[Handler, ...]
    times: tuple[tuple[str, int], ...] = ()
    """The names that stand for times in the formula, with nanoseconds."""


@dataclass(frozen=True)
class GivenValue(SyntaxNode):
    """`type name = default unit in least..most;`: a constant that operators may set. `bool` has no range."""

    type: tuple[str, ...]
    name: str
    default: str
    unit: str
    bounds: tuple[str, str] | None


@dataclass(frozen=True)
class TopicDeclaration(SyntaxNode):
    """`topic name = /default;`: a topic that a load may replace.

    One that `cancels` the goals on another topic of the specification follows that topic, and no load gives it.
    """

    name: str
    topic: str
    cancels: str = field(default="", compare=False)


@dataclass(frozen=True)
class TypedTopic(SyntaxNode):
    """`topic name : role = /default;`: a topic whose type is one of those of a role."""

    name: str
    role: str
    topic: str


@dataclass(frozen=True)
class GivenList(SyntaxNode):
    """`kind name = default;`: corners, limits of joints, hosts, or a time."""

    kind: str
    name: str
    default: str


@dataclass(frozen=True)
class TypedEvent(SyntaxNode):
    """An event on a typed topic: `names` are values of its role."""

    modifiers: tuple[Name, ...]
    name: str
    names: tuple[Name, ...]
    topic: str
    when: Expression | None
    action: Block


@dataclass(frozen=True)
class TypedSafe(SyntaxNode):
    """`safe { } on topic every period;`, of a typed topic."""

    topic: str
    period_ns: int


@dataclass(frozen=True)
class GivenItems(InitializerList):
    """The items of a table that operators set. A change of them keeps the state."""

    items: tuple[Expression, ...] = field(compare=False)


@dataclass(frozen=True)
class SafeDeclaration(SyntaxNode):
    """`safe type { field:value, … } on topic every period;`."""

    type: str
    type_position: Position = field(compare=False)
    fields: tuple[Binding, ...]
    topic: str
    period_ns: int


@dataclass(frozen=True)
class WithholdDeclaration(SyntaxNode):
    """`withhold topic from "network", … while condition;`."""

    topic: str
    networks: tuple[StringLiteral | Name, ...]
    condition: Name
    given: tuple[str, ...] = field(default=(), compare=False)
    """The networks that operators set, in place of `networks`."""


Switch = Literal["on", "shadow", "off", ""]
"""How a specification begins where it is not known, or empty for the setting of the robot."""


@dataclass(frozen=True)
class Specification(SyntaxNode):
    """One `name() { … }`."""

    modifiers: tuple[Name, ...]
    name: str
    parameters: tuple[ParameterDeclaration, ...]
    declarations: tuple[Declaration, ...]
    functions: tuple[FunctionDefinition, ...]
    inits: tuple[InitBlock, ...]
    events: tuple[EventDefinition, ...]
    properties: tuple[Property, ...]
    safes: tuple[SafeDeclaration, ...] = ()
    givens: tuple[GivenValue | TopicDeclaration, ...] = ()
    withholds: tuple[WithholdDeclaration, ...] = ()
    phase: Name | None = field(default=None, compare=False)
    switch: Switch = field(default="", compare=False)


@dataclass(frozen=True)
class TypedSpecification(SyntaxNode):
    """A specification with parts whose types or values are not known yet; `known` has all others."""

    known: Specification
    givens: tuple[GivenValue | TopicDeclaration | TypedTopic | GivenList, ...]
    events: tuple[EventDefinition | TypedEvent, ...]
    safes: tuple[SafeDeclaration | TypedSafe, ...]


@dataclass(frozen=True)
class RoleRow(SyntaxNode):
    """The values of a role in messages of one type, or with an empty `type`, of every other type.

    Without `action`, each value is a field. With it, the fields are `parameters`, and the statements make the values.
    A message that `cancels` cannot stop a robot: it is dropped instead, and a stop cancels all goals.
    """

    type: str
    parameters: tuple[ParameterDeclaration, ...]
    pattern: tuple[Binding, ...]
    cancels: bool
    action: Block | None


@dataclass(frozen=True)
class RoleDeclaration(SyntaxNode):
    """`role name(values) : base { rows }`."""

    name: str
    parameters: tuple[ParameterDeclaration, ...]
    base: str
    rows: tuple[RoleRow, ...]


@dataclass(frozen=True)
class Setting(SyntaxNode):
    """`name = value;` of a `preset` statement; the meaning of the value depends on what `name` is."""

    name: str
    value: str


@dataclass(frozen=True)
class PresetStatement(SyntaxNode):
    """`preset preset version as name switch { settings }`: the name and the values of the specification `preset`."""

    preset: str
    version: int
    name: str
    settings: tuple[Setting, ...]
    switch: Switch = ""


@dataclass(frozen=True)
class OrderStatement(SyntaxNode):
    """`order first < second;`"""

    names: tuple[Name, ...]


@dataclass(frozen=True)
class SpecificationFile:
    """The specifications and `order` statements of one file."""

    name: str
    text: str
    specifications: tuple[Specification, ...]
    orders: tuple[OrderStatement, ...] = ()


@dataclass(frozen=True)
class TypedFile:
    """A file as written, before types and values are chosen (`typed.py`)."""

    file: SpecificationFile
    specifications: tuple[Specification | TypedSpecification, ...]
    roles: tuple[RoleDeclaration, ...]
    presets: tuple[PresetStatement, ...]
