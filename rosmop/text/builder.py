"""Makes the tree of `tree.py` from lark's parse tree.

One method for each rule of the grammar. Walked without recursion, so that no nesting can exhaust the stack.
"""

# ruff: noqa: D102  a method is the rule of the grammar that has its name

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

from lark import Token, Transformer_NonRecursive, v_args
from lark.tree import Meta

from rosmop.form.positions import Finding, Position
from rosmop.text import literals, tree
from rosmop.text.complaints import FORBIDDEN
from rosmop.text.errors import SpecificationError

_T = TypeVar("_T", bound=tree.Node)


class _Unsaid:
    """Something that needs nothing: a stray `;`, a `using` line."""


def _binary(operator: str) -> Callable[..., tree.Binary]:
    def build(self: "Builder", meta: Meta, left: Any, right: Any) -> tree.Binary:
        return tree.Binary(self.at(meta), operator, left, right)

    return build


def _made(kind: Callable[..., _T], first: int = 0, **more: bool) -> Callable[..., _T]:
    """Of a rule whose children, from the `first` on, are the fields of its node."""

    def build(self: "Builder", meta: Meta, *children: Any) -> _T:
        given = (str(child) if isinstance(child, Token) else child for child in children[first:])
        return kind(self.at(meta), *given, **more)

    return build


def _all(_builder: "Builder", _: Meta, *children: Any) -> tuple[Any, ...]:
    return children


def _unsaid(_builder: "Builder", _: Meta, *_children: Any) -> _Unsaid:
    return _Unsaid()


@v_args(inline=True, meta=True)
class Builder(Transformer_NonRecursive[Token, Any]):
    """Builds the tree of one file; `findings` are the literals that mean nothing."""

    def __init__(self, file: str, text: str) -> None:
        super().__init__()
        self._file = file
        self._text = text
        self.findings: list[Finding] = []

    def at(self, meta: Meta | Token) -> Position:
        """Where a rule or token begins."""
        if isinstance(meta, Token):
            return Position(self._file, meta.line or 1, meta.column or 1)
        if meta.empty:
            return Position(self._file, 1, 1)
        return Position(self._file, meta.line, meta.column)

    def refuse(self, place: Meta | Token, text: str) -> None:
        """Remember an error."""
        self.findings.append(Finding(self.at(place), "error", text))

    # Files and specifications

    def file(self, _: Meta, *children: Any) -> tree.File:
        found = tuple(child for child in children if isinstance(child, tree.Specification))
        return tree.File(self._file, self._text, found)

    using = _unsaid

    def nothing(self, meta: Meta) -> tree.Statement:
        return tree.Block(self.at(meta), ())

    def specification(self, meta: Meta, *children: Any) -> tree.Specification:
        names = [
            child for child in children if isinstance(child, Token) and child.type in ("NAME", "MODIFIER")
        ]
        parameters = next((child for child in children if isinstance(child, tuple)), ())
        *modifiers, name = names

        def items(kind: type[_T]) -> tuple[_T, ...]:
            return tuple(child for child in children if isinstance(child, kind))

        return tree.Specification(
            self.at(name) if not modifiers else self.at(meta),
            tuple(tree.Name(self.at(word), (str(word),)) for word in modifiers),
            str(name),
            parameters,
            items(tree.Declaration),
            items(tree.Function),
            items(tree.Init),
            items(tree.Event),
            items(tree.Property),
        )

    def function(
        self, meta: Meta, kind: Any, name: Any, parameters: Any, body: Any
    ) -> tree.Function | tree.Init:
        if name == "init" and kind.name == ("void",):
            return self.init(meta, parameters, body)
        return tree.Function(self.at(meta), kind, str(name), parameters or (), body)

    prototype = _unsaid

    def procedure(self, meta: Meta, name: Any, parameters: Any, body: Any) -> tree.Function:
        return tree.Function(self.at(meta), None, str(name), parameters or (), body)

    def init(self, meta: Meta, parameters: Any, body: Any) -> tree.Init:
        if parameters:
            self.refuse(meta, "`init` takes no parameters: it runs before the first message")
        return tree.Init(self.at(meta), body)

    parameters = _all

    def unnamed_parameters(self, meta: Meta, *words: Any) -> tuple[tree.Parameter, ...]:
        if words != ("void",):
            self.refuse(meta, f"give the parameter a name: `{' '.join(words)} x`")
        return ()

    parameter = _made(tree.Parameter)

    def reference_parameter(self, meta: Meta, kind: Any, name: Any) -> tree.Parameter:
        return tree.Parameter(self.at(meta), _referenced(kind), str(name))

    def array_parameter(self, meta: Meta, kind: Any, name: Any) -> tree.Parameter:
        array = tree.TypeName(kind.position, ("[]",), element=kind)
        return tree.Parameter(self.at(meta), array, str(name))

    array_parameter_behind = array_parameter

    def array_reference_parameter(self, meta: Meta, kind: Any, name: Any) -> tree.Parameter:
        vector = tree.TypeName(kind.position, ("std", "vector"), element=kind)
        return self.reference_parameter(meta, vector, name)

    # Events and properties

    def event(self, meta: Meta, *children: Any) -> tree.Event:
        *modifiers, name, parameters, trigger, action = children
        words = tuple(tree.Name(self.at(word), (str(word),)) for word in modifiers)
        return tree.Event(self.at(meta), words, str(name), parameters or (), trigger, action)

    def trigger(
        self, meta: Meta, topic: Any, kind: Any, *rest: Any, part: str | None = None
    ) -> tree.MessageTrigger:
        name = str(kind).replace("::", "/")
        return tree.MessageTrigger(self.at(meta), str(topic), name, self.at(kind), part, *rest)

    def service_trigger(
        self, meta: Meta, _: Any, topic: Any, kind: Any, part: Any, *rest: Any
    ) -> tree.MessageTrigger:
        return self.trigger(meta, topic, kind, *rest, part=str(part))

    def timer(self, meta: Meta, _every: Any, duration: Any) -> tree.TimerTrigger:
        try:
            return tree.TimerTrigger(self.at(meta), literals.duration_ns(duration.strip()))
        except literals.BadLiteralError as error:
            self.refuse(duration, str(error))
            return tree.TimerTrigger(self.at(meta), 10**9)

    def pattern(self, _: Meta, _open: Any, fields: Any, _close: Any) -> tuple[tree.Binding, ...]:
        return tuple(fields or ())

    def fields(self, _: Meta, *groups: Any) -> list[tree.Binding]:
        return [binding for group in groups if group is not None for binding in group]

    def bind(self, meta: Meta, path: Any, name: Any) -> list[tree.Binding]:
        if name in ("true", "false"):
            constant = tree.Name(self.at(name), (str(name),))
            return [tree.Binding(self.at(meta), path, None, constant, self.at(name))]
        return [tree.Binding(self.at(meta), path, str(name), None, self.at(name))]

    def constrain(self, meta: Meta, path: Any, constant: Any) -> list[tree.Binding]:
        if isinstance(constant, list | tuple):
            constant = tree.Name(self.at(meta), tuple(constant))
        return [tree.Binding(self.at(meta), path, None, constant, constant.position)]

    def nest(self, _: Meta, path: Any, inner: Any) -> list[tree.Binding]:
        return [replace(binding, path=(*path, *binding.path)) for binding in inner or ()]

    path = _all

    def path_step(self, meta: Meta, name: Any, index: Any) -> tree.PathStep:
        if index is None:
            return tree.PathStep(self.at(meta), str(name), None)
        if not index.isdigit() or len(index) > 10:
            self.refuse(index, f"`{index[:20]}` is no index; write a whole number")
            return tree.PathStep(self.at(meta), str(name), 0)
        return tree.PathStep(self.at(meta), str(name), int(index))

    def property(self, meta: Meta, logic: Any, formula: Any, *handlers: Any) -> tree.Property:
        stripped = formula.lstrip()
        origin = self.at(formula).within(formula, len(formula) - len(stripped))
        return tree.Property(self.at(meta), str(logic), stripped.rstrip(), origin, tuple(handlers))

    handler = _made(tree.Handler, 1)

    # Types

    def type(self, meta: Meta, *children: Any) -> tree.TypeName:
        core = next(child for child in children if isinstance(child, tree.TypeName))
        constant = core.constant or "const" in children or "constexpr" in children
        static = "static" in children
        return replace(core, position=self.at(meta), constant=constant, static=static)

    def qualifier(self, _: Meta, word: Any) -> str:
        return str(word)

    def core(self, meta: Meta, *words: Any) -> tree.TypeName:
        if isinstance(words[0], tree.TypeName):
            return words[0]
        return tree.TypeName(self.at(meta), tuple(map(str, words)))

    def pointer(self, meta: Meta, *words: Any) -> tree.TypeName:
        return tree.TypeName(self.at(meta), tuple(map(str, words)), pointer=True)

    named = _made(tree.TypeName)

    def message(self, meta: Meta, name: Any) -> tree.TypeName:
        return tree.TypeName(self.at(meta), tuple(str(name).replace("::", "/").split("/")))

    def vector(self, meta: Meta, *children: Any) -> tree.TypeName:
        return tree.TypeName(self.at(meta), ("std", "vector"), element=children[-1])

    def vector_of_vectors(self, meta: Meta, *children: Any) -> tree.TypeName:
        return self.vector(meta, self.vector(meta, *children))

    def automatic(self, meta: Meta) -> tree.TypeName:
        return tree.TypeName(self.at(meta), ("auto",))

    def scoped(self, _: Meta, *children: Any) -> tuple[str, ...]:
        return tuple(str(child) for child in children if child is not None)

    # Statements

    def block(self, meta: Meta, *children: Any) -> tree.Block:
        return tree.Block(self.at(meta), children)

    evaluate = _made(tree.Evaluate)
    if_ = _made(tree.If, 1)
    while_ = _made(tree.While, 1)

    def do_(self, meta: Meta, _: Any, body: Any, condition: Any) -> tree.While:
        return tree.While(self.at(meta), condition, body, at_end=True)

    def for_(self, meta: Meta, _: Any, start: Any, condition: Any, step: Any, body: Any) -> tree.For:
        empty = isinstance(start, tree.Block)
        return tree.For(self.at(meta), None if empty else start, condition, step, body)

    range_for = _made(tree.RangeFor, 1)

    def range_for_reference(self, meta: Meta, word: Any, kind: Any, *more: Any) -> tree.RangeFor:
        return self.range_for(meta, word, _referenced(kind), *more)

    def switch(self, meta: Meta, _: Any, value: Any, *cases: Any) -> tree.Switch:
        return tree.Switch(self.at(meta), value, cases)

    def case(self, meta: Meta, _: Any, value: Any, *statements: Any) -> tree.Case:
        return tree.Case(self.at(meta), value, statements)

    def default(self, meta: Meta, _: Any, *statements: Any) -> tree.Case:
        return tree.Case(self.at(meta), None, statements)

    break_ = _made(tree.Break, 1)
    continue_ = _made(tree.Continue, 1)
    drop = _made(tree.Drop, 1)
    reset = _made(tree.Reset, 1)
    return_ = _made(tree.Return, 1)

    def delete(self, meta: Meta, *children: Any) -> tree.Delete:
        return tree.Delete(self.at(meta), children[-1])

    def publish(self, meta: Meta, _: Any, topic: Any, kind: Any, value: Any) -> tree.Publish:
        names = [_unquoted(child) if child.type == "STRING" else str(child) for child in (topic, kind)]
        return tree.Publish(self.at(meta), names[0], names[1].replace("::", "/"), self.at(kind), value)

    def declaration(self, meta: Meta, kind: Any, *declarators: Any) -> tree.Declaration:
        return tree.Declaration(self.at(meta), kind, declarators)

    plain_declarator = _made(tree.Declarator)
    initialized = _made(tree.Declarator)

    def constructed(self, meta: Meta, name: Any, arguments: Any) -> tree.Declarator:
        return tree.Declarator(self.at(meta), str(name), arguments=arguments)

    def braced(self, meta: Meta, name: Any, items: Any) -> tree.Declarator:
        return tree.Declarator(self.at(meta), str(name), value=self.elements_in_braces(meta, items))

    def sized(self, meta: Meta, name: Any, size: Any, value: Any = None) -> tree.Declarator:
        return tree.Declarator(self.at(meta), str(name), value=value, size=size, is_array=True)

    sized_assigned = sized

    def sized_initialized(self, meta: Meta, name: Any, size: Any, items: Any) -> tree.Declarator:
        return self.sized(meta, name, size, self.elements_in_braces(meta, items))

    def elements(self, _: Meta, *items: Any) -> tuple[tree.Expression, ...]:
        return tuple(item for item in items if item is not None)

    def elements_in_braces(self, meta: Meta, *children: Any) -> tree.Elements:
        return tree.Elements(self.at(meta), children[-1] or ())

    # Expressions

    def sequence(self, meta: Meta, *children: Any) -> tree.Sequence:
        return tree.Sequence(self.at(meta), children)

    def assign(self, meta: Meta, target: Any, operator: Any, value: Any) -> tree.Assign:
        return tree.Assign(self.at(meta), str(operator), target, value)

    def set(self, meta: Meta, target: Any, value: Any) -> tree.Assign:
        return tree.Assign(self.at(meta), "=", target, value)

    conditional = _made(tree.Conditional)

    def binary(self, meta: Meta, left: Any, operator: Any, right: Any) -> tree.Binary:
        return tree.Binary(self.at(meta), str(operator), left, right)

    bit_or_ = _binary("|")
    bit_xor_ = _binary("^")
    bit_and_ = _binary("&")
    less = _binary("<")
    greater = _binary(">")
    shift_left = _binary("<<")
    shift_right = _binary(">>")
    add = _binary("+")
    subtract = _binary("-")
    multiply = _binary("*")
    divide = _binary("/")
    remainder = _binary("%")

    prefix = _made(tree.Unary)
    step_before = _made(tree.Step, prefix=True)

    def step_after(self, meta: Meta, target: Any, operator: Any) -> tree.Step:
        return tree.Step(self.at(meta), str(operator), target, prefix=False)

    def parenthesis(self, _: Meta, _open: Any, inner: tree.Expression) -> tree.Expression:
        return inner

    def cast(self, meta: Meta, _open: Any, *children: Any) -> tree.Cast:
        *words, value = children
        if words[0].type == "FIXED":
            words = [part.strip() for part in words[0].split("::")]
        return tree.Cast(self.at(meta), tree.TypeName(self.at(meta), tuple(map(str, words))), value)

    def static_cast(self, meta: Meta, *children: Any) -> tree.Cast:
        return tree.Cast(self.at(meta), *(child for child in children if not isinstance(child, Token)))

    def convert(self, meta: Meta, *children: Any) -> tree.Construct:
        words = tuple(str(child) for child in children if _is_builtin(child))
        return tree.Construct(self.at(meta), tree.TypeName(self.at(meta), words), children[-1] or ())

    def construct_vector(self, meta: Meta, kind: Any, arguments: Any) -> tree.Construct:
        return tree.Construct(self.at(meta), kind, arguments or ())

    def construct_elements(self, meta: Meta, kind: Any, items: Any) -> tree.Construct:
        return tree.Construct(self.at(meta), kind, (self.elements_in_braces(meta, items),))

    def new(self, meta: Meta, *children: Any) -> tree.NewCharacters:
        words = [str(child) for child in children if _is_builtin(child)]
        if words != ["char"]:
            self.refuse(
                meta, f"`new {' '.join(words)}[…]` is not part of the language; write a `std::vector`"
            )
        return tree.NewCharacters(self.at(meta), children[-1])

    limit = _made(tree.Limit, 1)
    index = _made(tree.Index)
    member = _made(tree.Member)

    def call(self, meta: Meta, callee: Any, arguments: Any) -> tree.Call:
        return tree.Call(self.at(meta), callee, arguments or ())

    arguments = _all

    def number(self, meta: Meta | Token, *children: Any) -> tree.Number:
        return tree.Number(self.at(meta), str(children[-1]))

    def negative(self, meta: Meta, *children: Any) -> tree.Unary:
        return tree.Unary(self.at(meta), "-", self.number(children[-1], children[-1]))

    def name(self, meta: Meta, *children: Any) -> tree.Name:
        parts = children[0] if isinstance(children[0], tuple) else tuple(map(str, children))
        if len(parts) == 1 and parts[0] in FORBIDDEN:
            self.refuse(meta, f"`{parts[0]}` is not part of the language; {FORBIDDEN[parts[0]]}")
        return tree.Name(self.at(meta), parts)

    def string(self, meta: Meta, *parts: Token) -> tree.Text:
        value = b""
        for part in parts:
            try:
                value += literals.string_bytes(part[1:-1])
            except literals.BadLiteralError as error:
                self.refuse(part, str(error))
        return tree.Text(self.at(meta), value)

    def character(self, meta: Meta, quoted: Token) -> tree.Character:
        try:
            return tree.Character(self.at(meta), literals.character_value(quoted[1:-1]))
        except literals.BadLiteralError as error:
            self.refuse(meta, str(error))
            return tree.Character(self.at(meta), 0)


def _referenced(kind: tree.TypeName) -> tree.TypeName:
    return replace(kind, reference=True)


def _is_builtin(child: Any) -> bool:
    return isinstance(child, Token) and child.type == "BUILTIN"


def _unquoted(token: Token) -> str:
    try:
        return literals.string_bytes(token[1:-1]).decode("utf-8", "replace")
    except literals.BadLiteralError:
        return str(token)


def check(builder: Builder) -> None:
    """Raise what the builder found."""
    if builder.findings:
        raise SpecificationError(builder.findings)
