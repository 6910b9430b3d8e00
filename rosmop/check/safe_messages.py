"""Compile the safe messages of a specification: check and serialize them once, when the file is loaded."""

from typing import Any

from rosmop.check.event_functions import constant_of_field
from rosmop.check.locate import type_of_path
from rosmop.check.scope import CompilationContext, FunctionScope, SpecificationNames
from rosmop.check.statements import check_topic
from rosmop.form import nodes
from rosmop.form.compiled import Publication
from rosmop.form.findings import SpecificationError
from rosmop.form.sites import Site
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes, quote
from rosmop.types.resolve import record

_HEADER = "std_msgs/Header"
_SENT_WITH = frozenset({"seq", "stamp"})


def declare_safes(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> None:
    for node in specification.safes:
        try:
            safe = _compile(shared, names, specification, node)
        except SpecificationError as error:
            shared.findings += error.findings
            names.misdeclared.add("STOP")
            continue
        names.safes[safe.topic] = safe
        shared.publications.append(Publication(names.name, safe.topic, safe.type, node.position, safe=True))


def _compile(
    shared: CompilationContext,
    names: SpecificationNames,
    specification: tree.Specification,
    node: tree.SafeDeclaration,
) -> nodes.SafeMessage:
    check_topic(node.topic, node.position)
    if node.topic in names.safes:
        raise SpecificationError.at(
            node.position, f"the safe message of {node.topic} is declared twice; leave one of them out"
        )
    kind = record(node.type_position, node.type, shared.messages)
    used = [
        event.trigger.type
        for event in specification.events
        if isinstance(event.trigger, tree.MessageTrigger) and event.trigger.topic == node.topic
        if event.trigger.part is None
    ]
    if not used:
        text = f"no event of {names.name} is on {node.topic}, so {names.name} cannot hold it back"
        raise SpecificationError.at(
            node.position, f"{text}; write `event name() {node.topic} {node.type} '{{}}' {{ }}`"
        )
    if used[0] != node.type:
        raise SpecificationError.at(
            node.type_position, f"{node.topic} has the type {used[0]} in an event, and {node.type} here"
        )
    scope = FunctionScope(shared, names, "init")
    value: list[Any] = scope.values.maker(kind)()
    stamped = is_stamped(shared.messages, kind.name)
    for binding in node.fields:
        _assign(scope, kind.name, value, binding, stamped=stamped)
    out = bytearray()
    scope.values.encoder(kind)(value, out)
    site = shared.symbols.site(Site(node.position))
    return nodes.SafeMessage(node.topic, kind.name, bytes(out), stamped, node.period_ns, site)


def is_stamped(messages: MessageTypes, name: str) -> bool:
    return [field.notation for field in messages.definition(name).fields[:1]] == [_HEADER]


def _assign(
    scope: FunctionScope, kind: str, value: list[Any], binding: tree.Binding, *, stamped: bool
) -> None:
    path = binding.path
    field = type_of_path(scope.messages, kind, path)
    if binding.constant is None:
        name = quote(binding.variable or "")
        text = f"the fields of a safe message are constants, because it is serialized once; {name} is not one"
        raise SpecificationError.at(binding.value_position, text)
    if stamped and len(path) > 1 and path[1].name in _SENT_WITH and _first(scope, kind) == path[0].name:
        text = "`seq` and `stamp` of the header are set when the message is sent; leave them out"
        raise SpecificationError.at(path[1].position, text)
    held = constant_of_field(scope, binding, field)
    at: Any = value
    around: value_types.Type = value_types.RecordType(kind)
    places: list[int] = []
    for step in path:
        if not isinstance(around, value_types.RecordType):
            text = "a safe message has no single part of a time; leave the field out"
            raise SpecificationError.at(step.position, text)
        slot = scope.messages.slot(around.name, step.name)
        around = slot.type
        places.append(slot.index)
        if step.index is not None:
            assert isinstance(around, value_types.VectorType)  # `type_of_path` has checked this
            if around.length is None:
                text = f"`{step.name}` is empty in a safe message, because its length varies; leave it out"
                raise SpecificationError.at(step.position, text)
            places.append(step.index)
            around = around.element
    for place in places[:-1]:
        at = at[place]
    at[places[-1]] = held


def _first(scope: FunctionScope, kind: str) -> str:
    return next(iter(scope.messages.slots(kind)))
