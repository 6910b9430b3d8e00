"""Build the tree of `tree.py` from lark's parse tree, without recursion, so nesting cannot exhaust the stack."""

# Each method handles the rule of the grammar that has its name.

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from fractions import Fraction
from typing import TypeVar, cast

from lark import Token, Transformer_NonRecursive, v_args
from lark.tree import Meta

from rosmop.form.findings import Diagnostic, Position, SpecificationError
from rosmop.text import tree
from rosmop.text.complaints import FORBIDDEN

_T = TypeVar("_T", bound=tree.SyntaxNode)

_ESCAPE = re.compile(r"\\(x[0-9A-Fa-f]{1,2}|[0-7]{1,3}|.)", re.DOTALL)
_SIMPLE = {"n": 10, "t": 9, "r": 13, "a": 7, "b": 8, "f": 12, "v": 11, "\\": 92, "'": 39, '"': 34, "?": 63}
_UNITS_NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "": 10**9, "m": 60 * 10**9, "min": 60 * 10**9,
             "h": 3600 * 10**9}  # fmt: skip
_NUMBER = r"[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?"
_GIVEN = re.compile(
    rf"(?P<value>{_NUMBER}|true|false)(?P<unit>\s*(?!in\s)[A-Za-z%°µ][\w/^*.%°µ-]{{0,30}})?"
    rf"(?:\s+in\s+(?P<least>{_NUMBER})\s*\.\.\s*(?P<most>{_NUMBER}))?"
)
_DURATION = re.compile(r"(\d++(?:\.\d*+)?|\.\d++)\s*+([A-Za-z]*+)\Z")
MIN_PERIOD_NS = 10**6
MAX_PERIOD_NS = 10**18
"""About 31 years."""


_Parameters = tuple[tree.ParameterDeclaration, ...]
_Bindings = list[tree.Binding]
_Path = tuple[tree.PathStep, ...]
_Expressions = tuple[tree.Expression, ...]
_Given = tree.GivenValue | tree.TopicDeclaration | tree.TypedTopic | tree.GivenList
_TYPED = tree.TypedTopic | tree.GivenList | tree.TypedEvent | tree.TypedSafe


class _LiteralError(Exception):
    """An invalid literal; the text shows the correct form."""


class _Unsaid:
    """Marks text that has no node, such as a stray `;` or a `using` line."""


def _binary(operator: str) -> Callable[..., tree.BinaryExpression]:
    def build(
        self: "TreeBuilder", meta: Meta, left: tree.Expression, right: tree.Expression
    ) -> tree.BinaryExpression:
        return tree.BinaryExpression(self.at(meta), operator, left, right)

    return build


def _make(kind: Callable[..., _T], first: int = 0, **more: bool) -> Callable[..., _T]:
    def build(self: "TreeBuilder", meta: Meta, *children: object) -> _T:
        given = (str(child) if isinstance(child, Token) else child for child in children[first:])
        return kind(self.at(meta), *given, **more)

    return build


def _all(_builder: "TreeBuilder", _: Meta, *children: object) -> tuple[object, ...]:
    return children


def _unsaid(_builder: "TreeBuilder", _: Meta, *_children: object) -> _Unsaid:
    return _Unsaid()


def _child(children: Iterable[object], kind: type[_T]) -> _T:
    """Return the child of a kind, which the grammar requires."""
    return next(child for child in children if isinstance(child, kind))


@v_args(inline=True, meta=True)
class TreeBuilder(Transformer_NonRecursive[Token, tree.TypedFile]):
    """Builds the tree; `findings` lists the invalid literals."""

    def __init__(self, file: str, text: str) -> None:
        super().__init__()
        self._file = file
        self._text = text
        self.findings: list[Diagnostic] = []

    def at(self, meta: Meta | Token) -> Position:
        if isinstance(meta, Token):
            return Position(self._file, meta.line or 1, meta.column or 1)
        if meta.empty:
            return Position(self._file, 1, 1)
        return Position(self._file, meta.line, meta.column)

    def refuse(self, place: Meta | Token, text: str) -> None:
        self.findings.append(Diagnostic(self.at(place), "error", text))

    # Files and specifications

    def file(self, _: Meta, *children: object) -> tree.TypedFile:
        def items(kind: type[_T]) -> tuple[_T, ...]:
            return tuple(child for child in children if isinstance(child, kind))

        found = (
            child for child in children if isinstance(child, tree.Specification | tree.TypedSpecification)
        )
        file = tree.SpecificationFile(self._file, self._text, (), items(tree.OrderStatement))
        return tree.TypedFile(file, tuple(found), items(tree.RoleDeclaration), items(tree.PresetStatement))

    def preset(
        self,
        meta: Meta,
        preset: Token,
        version: Token,
        name: Token | None,
        switch: Token | None,
        *settings: tree.Setting | None,
    ) -> tree.PresetStatement:
        if not version.isdigit() or len(version) > 9:
            self.refuse(version, f"`{version[:20]}` is not a version; write a whole number")
        number = int(version) if version.isdigit() else 0
        values = tuple(setting for setting in settings if setting is not None)
        return tree.PresetStatement(
            self.at(meta),
            str(preset),
            number,
            str(name or preset),
            values,
            cast("tree.Switch", str(switch or "")),
        )

    def setting(self, meta: Meta, name: Token, value: Token) -> tree.Setting:
        return tree.Setting(self.at(meta), str(name), " ".join(value.split()))

    def role(
        self, meta: Meta, name: Token, parameters: _Parameters | None, base: Token | None, *rows: tree.RoleRow
    ) -> tree.RoleDeclaration:
        return tree.RoleDeclaration(self.at(meta), str(name), parameters or (), str(base or ""), rows)

    def row(  # noqa: PLR0917  the children of the rule
        self,
        meta: Meta,
        kind: Token,
        parameters: _Parameters | None,
        pattern: tuple[tree.Binding, ...],
        cancels: Token | None,
        action: tree.Block | None = None,
    ) -> tree.RoleRow:
        name = "" if kind.type == "DEFAULT" else str(kind).replace("::", "/")
        return tree.RoleRow(self.at(meta), name, parameters or (), pattern, cancels is not None, action)

    def order(self, meta: Meta, _word: Token, *names: Token) -> tree.OrderStatement:
        return tree.OrderStatement(
            self.at(meta), tuple(tree.Name(self.at(name), (str(name),)) for name in names)
        )

    using = _unsaid

    def nothing(self, meta: Meta) -> tree.Statement:
        return tree.Block(self.at(meta), ())

    def specification(self, meta: Meta, *children: object) -> tree.Specification | tree.TypedSpecification:
        names = [
            child for child in children if isinstance(child, Token) and child.type in ("NAME", "MODIFIER")
        ]
        parameters = next((child for child in children if isinstance(child, tuple)), ())
        givens = next((child for child in children if isinstance(child, list)), [])
        *modifiers, name = names

        def items(kind: type[_T]) -> tuple[_T, ...]:
            return tuple(child for child in children if isinstance(child, kind))

        known = tree.Specification(
            self.at(name) if not modifiers else self.at(meta),
            tuple(tree.Name(self.at(word), (str(word),)) for word in modifiers),
            str(name),
            parameters,
            items(tree.Declaration),
            items(tree.FunctionDefinition),
            items(tree.InitBlock),
            items(tree.EventDefinition),
            items(tree.Property),
            items(tree.SafeDeclaration),
            tuple(givens),
            items(tree.WithholdDeclaration),
            next((child for child in children if isinstance(child, tree.Name)), None),
        )
        if not any(isinstance(part, _TYPED) for part in (*children, *givens)):
            return known
        return tree.TypedSpecification(
            known.position,
            known,
            tuple(givens),
            tuple(child for child in children if isinstance(child, tree.EventDefinition | tree.TypedEvent)),
            tuple(child for child in children if isinstance(child, tree.SafeDeclaration | tree.TypedSafe)),
        )

    def function(
        self, meta: Meta, kind: tree.TypeName, name: Token, parameters: _Parameters | None, body: tree.Block
    ) -> tree.FunctionDefinition | tree.InitBlock:
        if name == "init" and kind.name == ("void",):
            return self.init(meta, parameters, body)
        return tree.FunctionDefinition(self.at(meta), kind, str(name), parameters or (), body)

    def phase(self, meta: Meta, name: Token) -> tree.Name:
        return tree.Name(self.at(meta), (str(name),))

    def given(self, _: Meta, _word: Token, *items: _Given) -> list[_Given]:
        return [*items]

    def given_value(self, meta: Meta, *children: Token) -> tree.GivenValue:
        *words, name, value = children
        match = _GIVEN.fullmatch(value.strip())
        if match is None:
            text = "write a number, its unit and its range, such as `0.22 m/s in 0..2`, or `true` or `false`"
            self.refuse(value, text)
            return tree.GivenValue(self.at(meta), tuple(map(str, words)), str(name), "0", "", None)
        bounds = None if match["least"] is None else (match["least"], match["most"])
        kind = tuple(map(str, words))
        return tree.GivenValue(
            self.at(meta), kind, str(name), match["value"], (match["unit"] or "").strip(), bounds
        )

    def given_topic(
        self, meta: Meta, _word: Token, name: Token, role: Token | None, topic: Token
    ) -> tree.TopicDeclaration | tree.TypedTopic:
        if role is not None:
            return tree.TypedTopic(self.at(meta), str(name), str(role), str(topic))
        return tree.TopicDeclaration(self.at(meta), str(name), str(topic))

    def given_list(self, meta: Meta, kind: Token, name: Token, value: Token) -> tree.GivenList:
        return tree.GivenList(self.at(meta), str(kind), str(name), value.strip())

    prototype = _unsaid

    def procedure(
        self, meta: Meta, name: Token, parameters: _Parameters | None, body: tree.Block
    ) -> tree.FunctionDefinition:
        return tree.FunctionDefinition(self.at(meta), None, str(name), parameters or (), body)

    def init(self, meta: Meta, parameters: _Parameters | None, body: tree.Block) -> tree.InitBlock:
        if parameters:
            self.refuse(meta, "`init` takes no parameters: it runs before the first message")
        return tree.InitBlock(self.at(meta), body)

    parameters = _all

    def unnamed_parameters(self, meta: Meta, *words: Token) -> _Parameters:
        if words != ("void",):
            self.refuse(meta, f"give the parameter a name: `{' '.join(words)} x`")
        return ()

    parameter = _make(tree.ParameterDeclaration)

    def reference_parameter(self, meta: Meta, kind: tree.TypeName, name: Token) -> tree.ParameterDeclaration:
        return tree.ParameterDeclaration(self.at(meta), _referenced(kind), str(name))

    def array_parameter(self, meta: Meta, kind: tree.TypeName, name: Token) -> tree.ParameterDeclaration:
        array = tree.TypeName(kind.position, ("[]",), element=kind)
        return tree.ParameterDeclaration(self.at(meta), array, str(name))

    array_parameter_behind = array_parameter

    def array_reference_parameter(
        self, meta: Meta, kind: tree.TypeName, name: Token
    ) -> tree.ParameterDeclaration:
        vector = tree.TypeName(kind.position, ("std", "vector"), element=kind)
        return self.reference_parameter(meta, vector, name)

    # Events and properties

    def event(self, meta: Meta, *children: object) -> tree.EventDefinition:
        *modifiers, name = (child for child in children if isinstance(child, Token))
        parameters = next((child for child in children if isinstance(child, tuple)), ())
        triggers = (child for child in children if isinstance(child, tree.MessageTrigger | tree.TimerTrigger))
        words = self.names(meta, *modifiers)
        action = _child(children, tree.Block)
        return tree.EventDefinition(self.at(meta), words, str(name), parameters, next(triggers), action)

    def typed_event(self, meta: Meta, *children: object) -> tree.TypedEvent:
        *modifiers, name, topic = (child for child in children if isinstance(child, Token))
        names = next((child for child in children if isinstance(child, tuple)), ())
        when = next((child for child in children if isinstance(child, tree.Expression)), None)
        words = self.names(meta, *modifiers)
        action = _child(children, tree.Block)
        return tree.TypedEvent(self.at(meta), words, str(name), names, str(topic), when, action)

    def names(self, _: Meta, *words: Token) -> tuple[tree.Name, ...]:
        return tuple(tree.Name(self.at(word), (str(word),)) for word in words)

    def trigger(  # noqa: PLR0917  the children of the rule
        self,
        meta: Meta,
        topic: Token,
        kind: Token,
        pattern: tuple[tree.Binding, ...],
        when: tree.Expression | None,
        part: str | None = None,
    ) -> tree.MessageTrigger:
        name = str(kind).replace("::", "/")
        return tree.MessageTrigger(self.at(meta), str(topic), name, self.at(kind), part, pattern, when)

    def service_trigger(  # noqa: PLR0917  the children of the rule
        self,
        meta: Meta,
        _: Token,
        topic: Token,
        kind: Token,
        part: Token,
        pattern: tuple[tree.Binding, ...],
        when: tree.Expression | None,
    ) -> tree.MessageTrigger:
        return self.trigger(meta, topic, kind, pattern, when, str(part))

    def timer(self, meta: Meta, _every: Token, duration: Token) -> tree.TimerTrigger:
        has_unit = duration.strip()[-1:].isalpha()
        return tree.TimerTrigger(self.at(meta), self._period_ns(duration), has_unit=has_unit)

    def _period_ns(self, duration: Token) -> int:
        try:
            return _duration_ns(duration.strip())
        except _LiteralError as error:
            self.refuse(duration, str(error))
            return 10**9

    def safe(
        self,
        meta: Meta,
        _: Token,
        kind: Token,
        fields: _Bindings | None,
        _on: Token,
        topic: Token,
        _every: Token,
        period: Token,
    ) -> tree.SafeDeclaration:
        name = str(kind).replace("::", "/")
        place = self.at(kind)
        return tree.SafeDeclaration(
            self.at(meta), name, place, tuple(fields or ()), str(topic), self._period_ns(period)
        )

    def typed_safe(
        self, meta: Meta, _: Token, _on: Token, topic: Token, _every: Token, period: Token
    ) -> tree.TypedSafe:
        return tree.TypedSafe(self.at(meta), str(topic), self._period_ns(period))

    def withhold(
        self, meta: Meta, _: Token, topic: Token, _from: Token, *rest: Token | tree.StringLiteral
    ) -> tree.WithholdDeclaration:
        *lists, _while, condition = (word for word in rest if isinstance(word, Token))
        texts = (text for text in rest if isinstance(text, tree.StringLiteral))
        networks: list[tree.StringLiteral | tree.Name] = [*texts, *self.names(meta, *lists)]
        return tree.WithholdDeclaration(
            self.at(meta), str(topic), tuple(networks), tree.Name(self.at(condition), (str(condition),))
        )

    def pattern(
        self, _: Meta, _open: Token, fields: _Bindings | None, _close: Token
    ) -> tuple[tree.Binding, ...]:
        return tuple(fields or ())

    def fields(self, _: Meta, *groups: _Bindings | None) -> _Bindings:
        return [binding for group in groups if group is not None for binding in group]

    def bind(self, meta: Meta, path: _Path, name: Token) -> _Bindings:
        if name in ("true", "false"):
            constant = tree.Name(self.at(name), (str(name),))
            return [tree.Binding(self.at(meta), path, None, constant, self.at(name))]
        return [tree.Binding(self.at(meta), path, str(name), None, self.at(name))]

    def constrain(self, meta: Meta, path: _Path, constant: tree.Expression) -> _Bindings:
        return [tree.Binding(self.at(meta), path, None, constant, constant.position)]

    def nest(self, _: Meta, path: _Path, inner: _Bindings | None) -> _Bindings:
        return [replace(binding, path=(*path, *binding.path)) for binding in inner or ()]

    path = _all

    def path_step(self, meta: Meta, name: Token, index: Token | None) -> tree.PathStep:
        if index is None:
            return tree.PathStep(self.at(meta), str(name), None)
        if not index.isdigit() or len(index) > 10:
            self.refuse(index, f"`{index[:20]}` is not an index; write a whole number")
            return tree.PathStep(self.at(meta), str(name), 0)
        return tree.PathStep(self.at(meta), str(name), int(index))

    def property(self, meta: Meta, logic: Token, formula: Token, *handlers: tree.Handler) -> tree.Property:
        stripped = formula.lstrip()
        origin = self.at(formula).within(formula, len(formula) - len(stripped))
        return tree.Property(self.at(meta), str(logic), stripped.rstrip(), origin, tuple(handlers))

    handler = _make(tree.Handler, 1)

    # Types

    def type(self, meta: Meta, *children: str | tree.TypeName) -> tree.TypeName:
        core = _child(children, tree.TypeName)
        constant = core.constant or "const" in children or "constexpr" in children
        static = "static" in children
        return replace(core, position=self.at(meta), constant=constant, static=static)

    def qualifier(self, _: Meta, word: Token) -> str:
        return str(word)

    def core(self, meta: Meta, *words: Token | tree.TypeName) -> tree.TypeName:
        if isinstance(words[0], tree.TypeName):
            return words[0]
        return tree.TypeName(self.at(meta), tuple(map(str, words)))

    def pointer(self, meta: Meta, *words: Token) -> tree.TypeName:
        return tree.TypeName(self.at(meta), tuple(map(str, words)), pointer=True)

    named = _make(tree.TypeName)

    def message(self, meta: Meta, name: Token) -> tree.TypeName:
        return tree.TypeName(self.at(meta), tuple(str(name).replace("::", "/").split("/")))

    def vector(self, meta: Meta, _word: Token, element: tree.TypeName) -> tree.TypeName:
        return tree.TypeName(self.at(meta), ("std", "vector"), element=element)

    def vector_of_vectors(
        self, meta: Meta, word: Token, inner: Token, element: tree.TypeName
    ) -> tree.TypeName:
        return self.vector(meta, word, self.vector(meta, inner, element))

    def automatic(self, meta: Meta) -> tree.TypeName:
        return tree.TypeName(self.at(meta), ("auto",))

    def scoped(self, _: Meta, *children: Token | None) -> tuple[str, ...]:
        return tuple(str(child) for child in children if child is not None)

    # Statements

    def block(self, meta: Meta, *children: tree.Statement) -> tree.Block:
        return tree.Block(self.at(meta), children)

    evaluate = _make(tree.ExpressionStatement)
    if_ = _make(tree.IfStatement, 1)
    while_ = _make(tree.WhileStatement, 1)

    def do_(
        self, meta: Meta, _: Token, body: tree.Statement, condition: tree.Expression
    ) -> tree.WhileStatement:
        return tree.WhileStatement(self.at(meta), condition, body, at_end=True)

    def for_(
        self,
        meta: Meta,
        _: Token,
        start: tree.Statement,
        condition: tree.Expression | None,
        step: tree.Expression | None,
        body: tree.Statement,
    ) -> tree.ForStatement:
        empty = isinstance(start, tree.Block)
        return tree.ForStatement(self.at(meta), None if empty else start, condition, step, body)

    range_for = _make(tree.RangeForStatement, 1)

    def range_for_reference(
        self, meta: Meta, word: Token, kind: tree.TypeName, *more: Token | tree.SyntaxNode
    ) -> tree.RangeForStatement:
        return self.range_for(meta, word, _referenced(kind), *more)

    def switch(
        self, meta: Meta, _: Token, value: tree.Expression, *cases: tree.SwitchCase
    ) -> tree.SwitchStatement:
        return tree.SwitchStatement(self.at(meta), value, cases)

    def case(
        self, meta: Meta, _: Token, value: tree.Expression, *statements: tree.Statement
    ) -> tree.SwitchCase:
        return tree.SwitchCase(self.at(meta), value, statements)

    def default(self, meta: Meta, _: Token, *statements: tree.Statement) -> tree.SwitchCase:
        return tree.SwitchCase(self.at(meta), None, statements)

    break_ = _make(tree.BreakStatement, 1)
    continue_ = _make(tree.ContinueStatement, 1)
    drop = _make(tree.DropStatement, 1)
    stop = _make(tree.StopStatement, 1)
    reset = _make(tree.ResetStatement, 1)
    return_ = _make(tree.ReturnStatement, 1)

    def delete(self, meta: Meta, _: Token, target: tree.Expression) -> tree.DeleteStatement:
        return tree.DeleteStatement(self.at(meta), target)

    def publish(
        self, meta: Meta, _: Token, topic: Token, kind: Token, value: tree.Expression
    ) -> tree.PublishStatement:
        return tree.PublishStatement(self.at(meta), *_resource(topic, kind), self.at(kind), value)

    def call_service(
        self, meta: Meta, _: Token, service: Token, kind: Token, value: tree.Expression
    ) -> tree.CallStatement:
        return tree.CallStatement(self.at(meta), *_resource(service, kind), self.at(kind), value)

    def declaration(self, meta: Meta, kind: tree.TypeName, *declarators: tree.Declarator) -> tree.Declaration:
        return tree.Declaration(self.at(meta), kind, declarators)

    plain_declarator = _make(tree.Declarator)
    initialized = _make(tree.Declarator)

    def constructed(self, meta: Meta, name: Token, arguments: _Expressions) -> tree.Declarator:
        return tree.Declarator(self.at(meta), str(name), arguments=arguments)

    def braced(self, meta: Meta, name: Token, items: _Expressions | None) -> tree.Declarator:
        return tree.Declarator(self.at(meta), str(name), value=self._in_braces(meta, items))

    def sized(
        self, meta: Meta, name: Token, size: tree.Expression | None, value: tree.Expression | None = None
    ) -> tree.Declarator:
        return tree.Declarator(self.at(meta), str(name), value=value, size=size, is_array=True)

    sized_assigned = sized

    def sized_initialized(
        self, meta: Meta, name: Token, size: tree.Expression | None, items: _Expressions | None
    ) -> tree.Declarator:
        return self.sized(meta, name, size, self._in_braces(meta, items))

    def elements(self, _: Meta, *items: tree.Expression | None) -> _Expressions:
        return tuple(item for item in items if item is not None)

    def elements_in_braces(self, meta: Meta, _: Token, items: _Expressions | None) -> tree.InitializerList:
        return self._in_braces(meta, items)

    def _in_braces(self, meta: Meta, items: _Expressions | None) -> tree.InitializerList:
        return tree.InitializerList(self.at(meta), items or ())

    # Expressions

    def sequence(self, meta: Meta, *children: tree.Expression) -> tree.CommaExpression:
        return tree.CommaExpression(self.at(meta), children)

    def assign(
        self, meta: Meta, target: tree.Expression, operator: Token, value: tree.Expression
    ) -> tree.Assignment:
        return tree.Assignment(self.at(meta), str(operator), target, value)

    def set(self, meta: Meta, target: tree.Expression, value: tree.Expression) -> tree.Assignment:
        return tree.Assignment(self.at(meta), "=", target, value)

    conditional = _make(tree.ConditionalExpression)

    def binary(
        self, meta: Meta, left: tree.Expression, operator: Token, right: tree.Expression
    ) -> tree.BinaryExpression:
        return tree.BinaryExpression(self.at(meta), str(operator), left, right)

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

    prefix = _make(tree.UnaryExpression)
    step_before = _make(tree.IncrementExpression, prefix=True)

    def step_after(self, meta: Meta, target: tree.Expression, operator: Token) -> tree.IncrementExpression:
        return tree.IncrementExpression(self.at(meta), str(operator), target, prefix=False)

    def parenthesis(self, _: Meta, _open: Token, inner: tree.Expression) -> tree.Expression:
        return inner

    def cast(self, meta: Meta, _open: Token, *children: Token | tree.Expression) -> tree.CastExpression:
        words = [child for child in children if isinstance(child, Token)]
        fixed = words[0].type == "FIXED"
        names = [part.strip() for part in words[0].split("::")] if fixed else [str(word) for word in words]
        kind = tree.TypeName(self.at(meta), tuple(names))
        return tree.CastExpression(self.at(meta), kind, _child(children, tree.Expression))

    def static_cast(
        self, meta: Meta, _: Token, kind: tree.TypeName, value: tree.Expression
    ) -> tree.CastExpression:
        return tree.CastExpression(self.at(meta), kind, value)

    def convert(self, meta: Meta, *children: Token | _Expressions | None) -> tree.ConstructorCall:
        words = tuple(str(child) for child in children if _is_builtin(child))
        arguments = next((child for child in children if isinstance(child, tuple)), ())
        return tree.ConstructorCall(self.at(meta), tree.TypeName(self.at(meta), words), arguments)

    def construct_vector(
        self, meta: Meta, kind: tree.TypeName, arguments: _Expressions | None
    ) -> tree.ConstructorCall:
        return tree.ConstructorCall(self.at(meta), kind, arguments or ())

    def construct_elements(
        self, meta: Meta, kind: tree.TypeName, items: _Expressions | None
    ) -> tree.ConstructorCall:
        return tree.ConstructorCall(self.at(meta), kind, (self._in_braces(meta, items),))

    def new(self, meta: Meta, *children: Token | tree.Expression) -> tree.NewExpression:
        words = [str(child) for child in children if _is_builtin(child)]
        if words != ["char"]:
            self.refuse(
                meta, f"`new {' '.join(words)}[…]` is not part of the language; write a `std::vector`"
            )
        return tree.NewExpression(self.at(meta), _child(children, tree.Expression))

    limit = _make(tree.NumericLimit, 1)
    index = _make(tree.IndexExpression)
    member = _make(tree.MemberAccess)

    def call(
        self, meta: Meta, callee: tree.Expression, arguments: _Expressions | None
    ) -> tree.CallExpression:
        return tree.CallExpression(self.at(meta), callee, arguments or ())

    arguments = _all

    def number(self, meta: Meta | Token, *children: Token) -> tree.NumberLiteral:
        return tree.NumberLiteral(self.at(meta), str(children[-1]))

    def negative(self, meta: Meta, *children: Token) -> tree.UnaryExpression:
        return tree.UnaryExpression(self.at(meta), "-", self.number(children[-1], children[-1]))

    def name(self, meta: Meta, *children: Token | tuple[str, ...]) -> tree.Name:
        parts = children[0] if isinstance(children[0], tuple) else tuple(map(str, children))
        if len(parts) == 1 and parts[0] in FORBIDDEN:
            self.refuse(meta, f"`{parts[0]}` is not part of the language; {FORBIDDEN[parts[0]]}")
        return tree.Name(self.at(meta), parts)

    def string(self, meta: Meta, *parts: Token) -> tree.StringLiteral:
        value = b""
        for part in parts:
            try:
                value += _string_bytes(part[1:-1])
            except _LiteralError as error:
                self.refuse(part, str(error))
        return tree.StringLiteral(self.at(meta), value)

    def character(self, meta: Meta, quoted: Token) -> tree.CharacterLiteral:
        try:
            return tree.CharacterLiteral(self.at(meta), _character_value(quoted[1:-1]))
        except _LiteralError as error:
            self.refuse(meta, str(error))
            return tree.CharacterLiteral(self.at(meta), 0)


def _referenced(kind: tree.TypeName) -> tree.TypeName:
    return replace(kind, reference=True)


def _is_builtin(child: object) -> bool:
    return isinstance(child, Token) and child.type == "BUILTIN"


def _unquote(token: Token) -> str:
    try:
        return _string_bytes(token[1:-1]).decode("utf-8", "replace")
    except _LiteralError:
        return str(token)


def check(builder: TreeBuilder) -> None:
    if builder.findings:
        raise SpecificationError(builder.findings)


def _string_bytes(inner: str) -> bytes:
    result = bytearray()
    last = 0
    for found in _ESCAPE.finditer(inner):
        result += inner[last : found.start()].encode("utf-8", "surrogatepass")
        result.append(_escape(found[1]))
        last = found.end()
    return bytes(result + inner[last:].encode("utf-8", "surrogatepass"))


def _character_value(inner: str) -> int:
    value = _string_bytes(inner)
    if len(value) != 1:
        raise _LiteralError("a character outside ASCII is more than one char; write a string")
    return value[0] - 256 if value[0] > 127 else value[0]


def _resource(name: Token, kind: Token) -> tuple[str, str]:
    names = [_unquote(child) if child.type == "STRING" else str(child) for child in (name, kind)]
    return names[0], names[1].replace("::", "/")


def _duration_ns(text: str) -> int:
    match = _DURATION.match(text)
    if match is None or len(match[1]) > 30:
        raise _LiteralError("this is not a duration; write for example `100ms`, `0.5s` or `2m`")
    if match[2] not in _UNITS_NS:
        units = ", ".join(unit for unit in _UNITS_NS if unit)
        raise _LiteralError(f"`{match[2][:20]}` is not a unit of time; write one of {units}")
    number = match[1] if match[1][0] != "." else "0" + match[1]
    result = Fraction(number.rstrip(".") if number.endswith(".") else number) * _UNITS_NS[match[2]]
    if result.denominator != 1 or not MIN_PERIOD_NS <= result <= MAX_PERIOD_NS:
        raise _LiteralError("a period is from 1 ms to 31 years, and a whole number of nanoseconds")
    return int(result)


def _escape(code: str) -> int:
    if code[0] == "x" and len(code) > 1:
        return int(code[1:], 16)
    if code[0] in "01234567":
        return int(code, 8) & 0xFF
    if code not in _SIMPLE:
        raise _LiteralError(f"`\\{code}` is not an escape; write `\\\\` for a backslash")
    return _SIMPLE[code]
