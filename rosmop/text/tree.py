"""The tree of an ``.rv`` file: frozen dataclasses, each with the position of its first character.

Strings are bytes, as in C++ (a character outside ASCII is its UTF-8 bytes). Nothing is resolved here: a name
is the tuple of its parts (`std::string` is `("std", "string")`).
"""

from dataclasses import dataclass, field

from rosmop.form.positions import Position


@dataclass(frozen=True)
class Node:
    """Anything that stands somewhere."""

    position: Position = field(compare=False)


# Types


@dataclass(frozen=True)
class TypeName(Node):
    """A type as written: `name` is ("unsigned", "int"), ("std", "string"), ("std", "vector"), ("[]",), ("auto",), …

    `element` is that of a vector or of an array `T[]`. `pointer` stands for `char *`, `reference` for `&`.
    """

    name: tuple[str, ...]
    element: "TypeName | None" = None
    constant: bool = False
    pointer: bool = False
    reference: bool = False
    static: bool = False


@dataclass(frozen=True)
class Parameter(Node):
    """A parameter of an event or of a helper function."""

    type: TypeName
    name: str


# Expressions


@dataclass(frozen=True)
class Expression(Node):
    """What has a value."""


@dataclass(frozen=True)
class Number(Expression):
    """A number as written, with its suffix."""

    text: str


@dataclass(frozen=True)
class Text(Expression):
    """A string literal."""

    value: bytes


@dataclass(frozen=True)
class Character(Expression):
    """A character literal, as a signed char."""

    value: int


@dataclass(frozen=True)
class Name(Expression):
    """A variable, constant, function or type: `x`, `std::max`, `true`."""

    parts: tuple[str, ...]


@dataclass(frozen=True)
class Unary(Expression):
    """`!` `-` `+` `~` in front of an operand."""

    operator: str
    operand: Expression


@dataclass(frozen=True)
class Step(Expression):
    """`++` or `--`, before or after its target."""

    operator: str
    target: Expression
    prefix: bool


@dataclass(frozen=True)
class Binary(Expression):
    """Two operands; `sign` is where the operator stands."""

    operator: str
    left: Expression
    right: Expression


@dataclass(frozen=True)
class Assign(Expression):
    """`=`, `+=`, …"""

    operator: str
    target: Expression
    value: Expression


@dataclass(frozen=True)
class Conditional(Expression):
    """`condition ? yes : no`."""

    condition: Expression
    yes: Expression
    no: Expression


@dataclass(frozen=True)
class Sequence(Expression):
    """`a, b`: the last one is the value."""

    items: tuple[Expression, ...]


@dataclass(frozen=True)
class Call(Expression):
    """A call of a function, of a member (the callee is a `Member`) or of a type."""

    callee: Expression
    arguments: tuple[Expression, ...]


@dataclass(frozen=True)
class Index(Expression):
    """`base[index]`."""

    base: Expression
    index: Expression


@dataclass(frozen=True)
class Member(Expression):
    """`base.name`."""

    base: Expression
    name: str


@dataclass(frozen=True)
class Cast(Expression):
    """`(int) x`, `static_cast<int>(x)`."""

    type: TypeName
    operand: Expression


@dataclass(frozen=True)
class Construct(Expression):
    """`int(x)`, `std::vector<double>(3, 0.0)`."""

    type: TypeName
    arguments: tuple[Expression, ...]


@dataclass(frozen=True)
class NewCharacters(Expression):
    """`new char[size]`."""

    size: Expression


@dataclass(frozen=True)
class Limit(Expression):
    """`std::numeric_limits<type>::name()`."""

    type: TypeName
    name: str


@dataclass(frozen=True)
class Elements(Expression):
    """`{1, 2, 3}`, where a vector is initialised or assigned."""

    items: tuple[Expression, ...]


# Statements


@dataclass(frozen=True)
class Statement(Node):
    """What is done."""


@dataclass(frozen=True)
class Declarator(Node):
    """One name of a declaration. `size` is that of `T name[size]`; `arguments` those of `T name(…)`."""

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
class Evaluate(Statement):
    """An expression for its effect."""

    expression: Expression


@dataclass(frozen=True)
class Block(Statement):
    """`{ … }`."""

    statements: tuple[Statement, ...]


@dataclass(frozen=True)
class If(Statement):
    """`if (condition) yes else no`."""

    condition: Expression
    yes: Statement
    no: Statement | None


@dataclass(frozen=True)
class While(Statement):
    """`while (condition) body`; with `at_end` the condition is looked at after the body (`do … while`)."""

    condition: Expression
    body: Statement
    at_end: bool = False


@dataclass(frozen=True)
class For(Statement):
    """`for (start; condition; step) body`."""

    start: Statement | None
    condition: Expression | None
    step: Expression | None
    body: Statement


@dataclass(frozen=True)
class RangeFor(Statement):
    """`for (type name : values) body`."""

    type: TypeName
    name: str
    values: Expression
    body: Statement


@dataclass(frozen=True)
class Case(Node):
    """The statements after one `case value:` (None: `default:`), up to the next."""

    value: Expression | None
    statements: tuple[Statement, ...]


@dataclass(frozen=True)
class Switch(Statement):
    """`switch (value) { case …: … }`."""

    value: Expression
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class Break(Statement):
    """`break;`."""


@dataclass(frozen=True)
class Continue(Statement):
    """`continue;`."""


@dataclass(frozen=True)
class Return(Statement):
    """`return value;`; without a value, an action drops the message."""

    value: Expression | None


@dataclass(frozen=True)
class Drop(Statement):
    """`DROP;`."""


@dataclass(frozen=True)
class Reset(Statement):
    """`__RESET;`."""


@dataclass(frozen=True)
class Delete(Statement):
    """`delete[] name;`: read, and needs nothing."""

    target: Expression


@dataclass(frozen=True)
class Publish(Statement):
    """`PUBLISH(topic, type, value);`."""

    topic: str
    type: str
    type_position: Position = field(compare=False)
    value: Expression


# Specifications


@dataclass(frozen=True)
class PathStep(Node):
    """One field of a path, with its index if it has one."""

    name: str
    index: int | None


@dataclass(frozen=True)
class Binding(Node):
    """A field of the pattern: its path from the message, and a variable or a constant."""

    path: tuple[PathStep, ...]
    variable: str | None
    constant: Expression | None
    value_position: Position = field(compare=False)


@dataclass(frozen=True)
class MessageTrigger(Node):
    """When an event happens: a message on a topic, or a request or response of a service (`part`)."""

    topic: str
    type: str
    type_position: Position = field(compare=False)
    part: str | None
    pattern: tuple[Binding, ...]
    when: Expression | None


@dataclass(frozen=True)
class TimerTrigger(Node):
    """When an event happens: every so many nanoseconds."""

    period_ns: int


@dataclass(frozen=True)
class Event(Node):
    """An event and its action."""

    modifiers: tuple[Name, ...]
    name: str
    parameters: tuple[Parameter, ...]
    trigger: MessageTrigger | TimerTrigger
    action: Block


@dataclass(frozen=True)
class Function(Node):
    """A helper function."""

    type: TypeName | None
    name: str
    parameters: tuple[Parameter, ...]
    body: Block


@dataclass(frozen=True)
class Init(Node):
    """`init() { … }`."""

    body: Block


@dataclass(frozen=True)
class Handler(Node):
    """`@category { … }`."""

    category: str
    body: Block


@dataclass(frozen=True)
class Property(Node):
    """A formula of a logic, and its handlers; `formula_position` is where the formula begins."""

    logic: str
    formula: str
    formula_position: Position = field(compare=False)
    handlers: tuple[Handler, ...]


@dataclass(frozen=True)
class Specification(Node):
    """One `name() { … }`."""

    modifiers: tuple[Name, ...]
    name: str
    parameters: tuple[Parameter, ...]
    declarations: tuple[Declaration, ...]
    functions: tuple[Function, ...]
    inits: tuple[Init, ...]
    events: tuple[Event, ...]
    properties: tuple[Property, ...]


@dataclass(frozen=True)
class File:
    """The specifications of one file, in order; `text` is what they were read from."""

    name: str
    text: str
    specifications: tuple[Specification, ...]
