"""Compile the givens of a specification: constants that operators set while it runs, and topics that a load replaces.

A constant is a variable of the set that no function assigns, so code and proofs hold for all of its values.
First values and `init` cannot read it, because they would keep the value of the start.
"""

from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from hashlib import sha256
from typing import Any

from rosmop.check.assignables import Variable
from rosmop.check.scope import CompilationContext, SpecificationNames
from rosmop.check.statements import check_topic
from rosmop.form.compiled import Given, GivenTopic
from rosmop.form.findings import Diagnostic, Position, SpecificationError
from rosmop.runtime.numbers import f32
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import quote
from rosmop.types.resolve import resolve

Topics = Mapping[str, Mapping[str, str]]


def declare_givens(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> None:
    for node in specification.givens:
        if not isinstance(node, tree.GivenValue):
            continue
        try:
            given = _given(shared, names, node)
        except SpecificationError as error:
            shared.findings += error.findings
            names.misdeclared.add(node.name)
            continue
        names.givens[node.name] = given
        shared.variables.declare(
            names, Variable(node.name, given.type, given.code, node.position, shared=True, constant=True)
        )


def _given(shared: CompilationContext, names: SpecificationNames, node: tree.GivenValue) -> Given:
    kind = resolve(tree.TypeName(node.position, node.type), shared.messages)
    code = shared.symbols.fresh("g")
    if node.name in names.variables:
        raise SpecificationError.at(node.position, f"{quote(node.name)} is declared twice")
    if isinstance(kind, value_types.BoolType):
        if node.bounds is not None or node.unit or node.default not in ("true", "false"):
            raise SpecificationError.at(node.position, f"write `bool {node.name} = true;` or `false`")
        return Given(node.name, code, kind, "", node.default == "true", None)
    if node.bounds is None or node.default in ("true", "false"):
        text = f"{quote(node.name)} needs a range; write for example `{node.name} = 1 in 0..2`"
        raise SpecificationError.at(node.position, text)
    default, least, most = (_number(kind, text, node.position) for text in (node.default, *node.bounds))
    given = Given(node.name, code, kind, node.unit, default, (least, most))
    if not given.holds(default):
        text = f"the default {node.default} of {quote(node.name)} is outside of its range"
        raise SpecificationError.at(node.position, f"{text} {node.bounds[0]}..{node.bounds[1]}")
    return given


def _number(kind: value_types.Type, text: str, position: Position) -> int | float:
    value = float(text)
    if isinstance(kind, value_types.FloatingType):
        held = value if kind.bits == 64 else f32(value)
        if held - held == 0:
            return held
    elif (
        isinstance(kind, value_types.IntegerType) and kind.least <= value <= kind.most and value.is_integer()
    ):
        return int(value)
    raise SpecificationError.at(position, f"{kind} cannot hold {text}")


def with_topics(specification: tree.Specification, given: Mapping[str, str]) -> tree.Specification:
    topics = _topics(specification, given)
    renamed: tree.Specification = _rename(specification, topics) if topics else specification
    return renamed


def _topics(specification: tree.Specification, given: Mapping[str, str]) -> dict[str, str]:
    declared = [one for one in specification.givens if isinstance(one, tree.TopicDeclaration)]
    topics = {one.name: given.get(one.name, one.topic) for one in declared}
    return topics | {one.name: tree.cancelling(topics[one.cancels]) for one in declared if one.cancels}


def _rename(node: Any, topics: Mapping[str, str]) -> Any:
    if isinstance(node, tuple):
        return tuple(_rename(part, topics) for part in node)
    if not isinstance(node, tree.SyntaxNode) or isinstance(node, tree.TopicDeclaration):
        return node
    changed: dict[str, Any] = {}
    for field, part in zip(fields(node), tree.fields_of(node), strict=True):
        if field.name == "topic":
            changed[field.name] = topics.get(part, part)
        elif isinstance(part, tuple | tree.SyntaxNode):
            changed[field.name] = _rename(part, topics)
    return replace(node, **changed)


def given_topics(
    shared: CompilationContext, specification: tree.Specification, given: Mapping[str, str]
) -> tuple[GivenTopic, ...]:
    topics = _topics(specification, given)
    found: dict[str, GivenTopic | None] = {}
    for node in specification.givens:
        if isinstance(node, tree.TopicDeclaration):
            topic = topics[node.name]
            try:
                check_topic(topic, node.position)
            except SpecificationError as error:
                shared.findings += error.findings
            if node.name in found:
                text = f"the topic {quote(node.name)} is given twice"
                shared.findings.append(Diagnostic(node.position, "error", text))
            found[node.name] = None if node.cancels else GivenTopic(node.name, topic, node.topic)
    return tuple(one for one in found.values() if one is not None)


def with_given(identity: bytes, topics: tuple[GivenTopic, ...]) -> bytes:
    """Return the identity of a state, which belongs to the text and to the topics that replace defaults."""
    changed = [(topic.name, topic.topic) for topic in topics if topic.topic != topic.default]
    return sha256(identity + repr(changed).encode()).digest() if changed else identity


def read_at_start(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> Iterator[Diagnostic]:
    def is_given(name: str) -> bool:
        if name in names.variables:
            return name in names.givens
        return any(name in other.givens for other in shared.variables.owners.get(name, ()))

    for start in (*specification.declarations, *specification.inits):
        waiting: list[tree.SyntaxNode] = [start]
        seen: set[str] = set()
        while waiting:
            for node in tree.walk(waiting.pop()):
                name = node.parts[0] if isinstance(node, tree.Name) and len(node.parts) == 1 else ""
                if name in names.functions and name not in seen:
                    waiting.append(names.functions[name].node)
                elif name not in seen and is_given(name):
                    text = f"{quote(name)} may change while {names.name} runs, and a value of the start would not"
                    yield Diagnostic(start.position, "error", f"{text}; use {quote(name)} where it is needed")
                seen.add(name)
