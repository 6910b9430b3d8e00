"""Find the topics, and parts of services, on which a specification acts: all others it only observes.

It acts where it may drop or change a message, replace it by the safe message, withhold it, or publish one. While it
cannot judge, it holds these topics and nothing else.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping

from rosmop.form import nodes
from rosmop.form.compiled import SpecificationCode, channel_of
from rosmop.text import tree

_DROPS = (tree.DropStatement, tree.ReturnStatement, tree.StopStatement)
_READING = frozenset({"size", "length", "empty", "at", "front", "back", "c_str", "find", "rfind", "substr",
                      "compare", "toSec", "toNSec", "isZero"})  # fmt: skip
"""Members that change nothing; any other may change a field of the message."""


def published_topics(functions: Iterable[nodes.Function]) -> Mapping[str, set[str]]:
    """Return the topics on which functions publish, by their context."""
    found: dict[str, set[str]] = {}
    for function in functions:
        topics = found.setdefault(function.context, set())
        topics |= {
            node.topic
            for node in nodes.walk(function)
            if isinstance(node, nodes.Publish) and not node.service
        }
    return found


def acted_topics(
    code: SpecificationCode, functions: Mapping[str, nodes.Function], published: Collection[str]
) -> tuple[str, ...]:
    """Return the channels of the specification's own events on which it acts, in order.

    `published` has the topics on which its functions publish.
    """
    channels = {event.channel for event in code.events if event.channel is not None}
    acted: set[str | None] = {None}
    acted |= {safe.topic for safe in code.safes} | {withholding.topic for withholding in code.withholdings}
    acted |= {*published}
    acted |= {event.channel for event in code.events if _acts(functions[event.function])}
    for declared in code.properties:
        acting = {name for name, function in declared.handlers.items() if _acts(functions[function])}
        acted |= {
            code.events[number].channel
            for number in range(len(declared.property.events))
            if acting & declared.property.categories_after(number)
        }
    return tuple(sorted(channel for channel in channels if channel in acted))


def written_topics(specification: tree.Specification) -> tuple[str, ...]:
    """Return the channels on which the text of a specification that cannot be compiled may act, and perhaps more."""
    helpers = {function.name for function in specification.functions if _takes_references(function)}
    acting = any(
        isinstance(node, _DROPS)
        for declared in specification.properties
        for node in tree.walk(declared.handlers)
    )
    acted = {safe.topic for safe in specification.safes} | {one.topic for one in specification.withholds}
    acted |= {
        node.topic for node in tree.walk(specification.events) if isinstance(node, tree.PublishStatement)
    }
    return tuple(
        sorted({
            channel
            for event, channel in _channels(specification)
            if acting or channel in acted or _may_act(event, helpers)
        })
    )  # fmt: skip


def _acts(function: nodes.Function) -> bool:
    return any(
        isinstance(node, nodes.Drop) or (isinstance(node, nodes.WriteBack) and node.writes)
        for node in nodes.walk(function)
    )


def _channels(specification: tree.Specification) -> Iterator[tuple[tree.EventDefinition, str]]:
    for event in specification.events:
        trigger = event.trigger
        if isinstance(trigger, tree.MessageTrigger):
            yield event, trigger.topic if trigger.part is None else channel_of(trigger.topic, trigger.part)


def _takes_references(function: tree.FunctionDefinition) -> bool:
    return any(parameter.type.reference and not parameter.type.constant for parameter in function.parameters)


def _may_act(event: tree.EventDefinition, helpers: set[str]) -> bool:
    own = {parameter.name for parameter in event.parameters}
    for node in tree.walk((event.action, event.after)):
        if isinstance(node, tree.DropStatement | tree.ReturnStatement):
            return True
        if isinstance(node, tree.Assignment | tree.IncrementExpression) and _root(node.target) in own:
            return True
        if isinstance(node, tree.CallExpression) and (
            (_root(node.callee) in helpers and not own.isdisjoint(map(_root, node.arguments)))
            or _changes(node.callee, own)
        ):
            return True
        if isinstance(node, tree.RangeForStatement) and node.type.reference and _root(node.values) in own:
            return True
        if isinstance(node, tree.Declaration) and node.type.reference:
            return True
    return False


def _changes(callee: tree.Expression, own: set[str]) -> bool:
    return isinstance(callee, tree.MemberAccess) and callee.name not in _READING and _root(callee) in own


def _root(expression: tree.Expression) -> str:
    while isinstance(expression, tree.MemberAccess | tree.IndexExpression):
        expression = expression.base
    return expression.parts[-1] if isinstance(expression, tree.Name) else ""
