"""Rewrite patterns that refer to an earlier message: `globally: a as A forbids b {x < @A.x}`.

Only the extreme earlier value matters: `x < @A.x` holds for some earlier `A` exactly if `x` is less than the greatest
`A.x`, which a variable keeps. With `within`, a list keeps the values that can still become the extreme one. A new
event happens with each later message that violates the pattern, and the property becomes `globally: no …` of this
event.
"""

import re
from dataclasses import fields, replace
from typing import Any, NoReturn

from rosmop.form.findings import Diagnostic, Position, SpecificationError
from rosmop.logics.interface import FormulaError, Source
from rosmop.logics.lexer import TokenReader
from rosmop.text import tree
from rosmop.text.parser import parse

_FORM = re.compile(
    r"(?P<scope>[^:]*):\s*(?P<first>\w+)(?:\s+as\s+(?P<alias>\w+))?\s+(?P<verb>\w+)\s+(?P<second>\w+)\s*"
    r"\{(?P<condition>[^{}]*)\}\s*(?:within\b\s*(?P<within>[^{}@]+))?"
)
_SCOPE = re.compile(r"globally|(?:after\s+(?P<opens>\w+))?\s*(?:until\s+(?P<closes>\w+))?")
_REFERENCE = re.compile(r"@(\w+)\.(\w+)")
_INSIDE = "referred_to_"
_BLOCKS = frozenset({"keep", "opens", "closes"})
_PREFIX = "kept_by_pattern_"
_SHAPE = "`globally: a as A forbids b {x < @A.x}`, or `b as B requires a {x < @B.x}`"


def with_references(specification: tree.Specification) -> tree.Specification:
    for number, node in enumerate(specification.properties, 1):
        if _refers(node):
            specification = _Rewriting(specification, node, number).rewrite()
    return specification


def without_references(specification: tree.Specification) -> tree.Specification:
    return replace(
        specification, properties=tuple(node for node in specification.properties if not _refers(node))
    )


def _refers(node: tree.Property) -> bool:
    return node.logic.lower() == "pattern" and "{" in node.formula


class _Rewriting:
    def __init__(self, specification: tree.Specification, node: tree.Property, number: int) -> None:
        self._specification, self._node = specification, node
        match = _FORM.fullmatch(node.formula)
        scope = None if match is None else _SCOPE.fullmatch(match["scope"].strip())
        if match is None or scope is None:
            self._refuse(f"a pattern with a condition has the form {_SHAPE}")
        if match["verb"] == "causes":
            self._refuse(
                "`causes` cannot refer to a message; for an equal field use a parameter of the specification"
            )
        if match["verb"] not in ("forbids", "requires") or match["alias"] is None:
            self._refuse(f"a pattern with a condition has the form {_SHAPE}")
        self._requires = match["verb"] == "requires"
        self._alias, self._condition = match["alias"], match["condition"]
        self._opens, self._closes = scope["opens"], scope["closes"]
        named, other = self._event(match["first"]), self._event(match["second"])
        self._early, self._late = (other, named) if self._requires else (named, other)
        self._within = None if match["within"] is None else self._duration(match)
        self._name = f"{self._late.name}_{self._alias}"
        self._prefix = _PREFIX + str(number)

    def rewrite(self) -> tree.Specification:
        operator, early, late = self._sides()
        specification, node = self._specification, self._node
        if any(event.name == self._name for event in specification.events):
            self._refuse(f"there is already an event `{self._name}`, the name for a violation; rename it")
        if self._within is not None and specification.parameters:
            self._refuse(
                "slices do not keep lists, which `within` with a reference needs; leave out the parameters"
            )
        if self._early is self._late and self._early.action.statements:
            self._refuse(
                f"`{self._late.name}` refers to itself, so its action must be empty; use two events on the topic"
            )
        p = self._prefix
        greatest = operator in ("<", "<=")
        sign = ">" if greatest else "<"
        keep = f"if (!{p}any || value {sign} {p}value) {{ {p}value = value; }} {p}any = true;"
        members = (
            f"bool {p}open = {'false' if self._opens else 'true'}; bool {p}any = false; double {p}value = 0;"
        )
        test = f"{p}any && late {operator} {p}value"
        if self._within is not None:
            members = f"bool {p}open = {'false' if self._opens else 'true'}; std::vector<double> {p}values;"
            members += f" std::vector<long> {p}times; long {p}now() {{ return ros::Time::now().toNSec(); }}"
            keep = f"""while ({p}values.size() > 0 && !({p}values.back() {sign} value)) {{ {p}values.pop_back();
                {p}times.pop_back(); }} {p}values.push_back(value); {p}times.push_back({p}now());
                while ({p}now() - {p}times[0] > {self._within}) {{ {p}values.erase({p}values.begin());
                {p}times.erase({p}times.begin()); }}"""
            test = f"{p}found(late)"
            members += f""" bool {p}found(double late) {{ for (long i = 0; i < {p}times.size(); i++) {{
                if ({p}now() - {p}times[i] <= {self._within}) {{ return late {operator} {p}values[i]; }} }}
                return false; }}"""
        members += f" bool {p}violates(double late) {{ return {'!' if self._requires else ''}({test}); }}"
        clear = f"{p}any = false;" if self._within is None else f"{p}values.clear(); {p}times.clear();"
        made = self._parse(
            f"{members} event e() /t std_msgs/Empty '{{}}' {{ }} void keep() {{ double value = 0;"
            f" if ({p}open && value == value) {{ {keep} }} }}"
            f" void opens() {{ if (!{p}open) {{ {clear} {p}open = true; }} }}"
            f" void closes() {{ {clear} {p}open = false; }}"
        )
        parts = {function.name: function for function in made.functions}
        value = parts["keep"].body.statements[0]
        assert isinstance(value, tree.Declaration)  # as written above
        declarator = replace(value.declarators[0], value=early)
        keeping = (replace(value, declarators=(declarator,)), *parts["keep"].body.statements[1:])
        events: list[tree.EventDefinition] = []
        for event in specification.events:
            after = event.after
            if event is self._early and event.name == self._opens:
                first, opened = tree.Block(node.position, keeping), parts["opens"].body.statements[0]
                assert isinstance(opened, tree.IfStatement)  # as written above
                after = (*after, replace(opened, no=first))
            else:
                after += (tree.Block(node.position, keeping),) if event is self._early else ()
                after += parts["opens"].body.statements if event.name == self._opens else ()
            after += parts["closes"].body.statements if event.name == self._closes else ()
            changed = replace(event, after=after)
            violated = self._violation(event, late) if event is self._late else None
            before = [] if violated is None else [violated]
            events += [*before, changed] if event is self._early else [changed, *before]
        scope = node.formula.partition(":")[0]
        # The comment names the events, which would be reported as unused otherwise.
        rewritten = replace(node, formula=f"{scope}: no {self._name} // {self._early.name} {self._late.name}")
        return replace(
            specification,
            declarations=(*specification.declarations, *made.declarations),
            functions=(
                *specification.functions,
                *(part for name, part in parts.items() if name not in _BLOCKS),
            ),
            events=tuple(events),
            properties=tuple(rewritten if one is node else one for one in specification.properties),
        )

    def _violation(self, event: tree.EventDefinition, late: tree.Expression) -> tree.EventDefinition:
        trigger, position = event.trigger, self._node.formula_position
        assert isinstance(trigger, tree.MessageTrigger)  # `_event` checks this
        test: tree.Expression = tree.CallExpression(
            position, tree.Name(position, (_hide(f"{self._prefix}violates"),)), (late,)
        )
        opened = tree.Name(position, (_hide(f"{self._prefix}open"),))
        test = tree.BinaryExpression(position, "&&", opened, test)
        if trigger.when is not None:
            test = tree.BinaryExpression(position, "&&", trigger.when, test)
        return replace(
            event,
            name=self._name,
            modifiers=(),
            trigger=replace(trigger, when=test),
            action=tree.Block(event.position, ()),
            after=(),
        )

    def _sides(self) -> tuple[str, tree.Expression, tree.Expression]:
        condition = self._condition
        for alias, _ in _REFERENCE.findall(condition):
            if alias != self._alias:
                self._refuse(f"`@{alias}` is not the message that this pattern names; write `@{self._alias}`")
        expression = _REFERENCE.sub(rf"{_INSIDE}\2", condition)
        made = self._parse(f"bool f() {{ return {expression}; }}")
        [returned] = made.functions[0].body.statements
        assert isinstance(returned, tree.ReturnStatement)  # as written above
        test = returned.value
        if not isinstance(test, tree.BinaryExpression) or test.operator not in ("<", "<=", ">", ">="):
            self._refuse(
                "the condition is one comparison `<`, `<=`, `>` or `>=` with the earlier message; for an equal"
                " field use a parameter of the specification"
            )
        referring = [any(map(_is_reference, tree.walk(side))) for side in (test.left, test.right)]
        if referring[0] is referring[1]:
            self._refuse(f"one side of the condition refers to `@{self._alias}`, and the other does not")
        named, other = (test.left, test.right) if referring[0] else (test.right, test.left)
        operator = test.operator
        later_first = referring[0] is self._requires
        if not later_first:
            operator = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}[operator]
        named = _without_prefix(named)
        return (operator, other, named) if self._requires else (operator, named, other)

    def _event(self, name: str) -> tree.EventDefinition:
        events = {
            event.name: event
            for event in self._specification.events
            if isinstance(event.trigger, tree.MessageTrigger)
        }
        if name not in events:
            self._refuse(f"`{name}` is not an event of this specification with a message")
        return events[name]

    def _duration(self, match: re.Match[str]) -> int:
        node = self._node
        origin = node.formula_position.within(node.formula, match.start("within"))
        try:
            reader = TokenReader(Source("pattern", match["within"].rstrip(), (), origin), ())
            within = reader.duration("a time bound")
            if reader.token.kind != "end":
                raise reader.unexpected("the end of the pattern")
        except FormulaError as error:
            raise SpecificationError(error.findings) from None
        return within

    def _parse(self, members: str) -> tree.Specification:
        position = self._node.formula_position
        try:
            [specification] = parse(f"s() {{ {members} }}", position.file).specifications
        except SpecificationError as error:
            self._refuse(f"the condition is not valid: {error.findings[0].text}")
        moved: tree.Specification = _move(specification, position)
        return moved

    def _refuse(self, text: str) -> NoReturn:
        raise SpecificationError([Diagnostic(self._node.formula_position, "error", text)])


def _is_reference(node: tree.SyntaxNode) -> bool:
    return isinstance(node, tree.Name) and node.parts[0].startswith(_INSIDE)


def _map(node: Any, change: Any) -> Any:
    if isinstance(node, tuple):
        return tuple(_map(part, change) for part in node)
    if not isinstance(node, tree.SyntaxNode):
        return node
    names = [field.name for field in fields(node)]
    parts = [_map(part, change) for part in tree.fields_of(node)]
    return change(replace(node, **dict(zip(names, parts, strict=True))))


def _move(node: Any, position: Position) -> Any:
    def move(one: tree.SyntaxNode) -> tree.SyntaxNode:
        one = replace(one, position=position)
        if isinstance(one, tree.Name):
            return replace(one, parts=tuple(map(_hide, one.parts)))
        if isinstance(one, tree.Declarator | tree.FunctionDefinition):
            return replace(one, name=_hide(one.name))
        return one

    return _map(node, move)


def _hide(name: str) -> str:
    return name.replace(_PREFIX, "pattern ")


def _without_prefix(node: Any) -> Any:
    def rename(one: tree.SyntaxNode) -> tree.SyntaxNode:
        if not isinstance(one, tree.Name) or not _is_reference(one):
            return one
        return replace(one, parts=(one.parts[0].removeprefix(_INSIDE), *one.parts[1:]))

    return _map(node, rename)
