"""List the messages that a module leaves to the interpreter, and why (`rosmop check --why-slow`)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from rosmop.fast.batch_codegen import written_of
from rosmop.fast.memory_layout import NotCompiledError
from rosmop.form import nodes
from rosmop.form.compiled import Compiled, PropertyCode, SpecificationCode
from rosmop.form.findings import Position
from rosmop.logics.interface import ClockedProperty, FiniteProperty


@dataclass(frozen=True)
class SlowPath:
    """Messages that the interpreter processes.

    `topic` may be a service with `request` or `response`. `code` is the event or handler, or empty if no message of
    the topic is compiled. `position` is the code that cannot be compiled.
    """

    topic: str
    code: str
    position: Position
    reason: str


def slow_paths(compiled: Compiled) -> list[SlowPath]:
    module = written_of(compiled)
    paths: dict[SlowPath, None] = {}
    channels = dict.fromkeys(
        event.channel for one in compiled.specifications for event in one.events if event.channel is not None
    )
    for channel in channels:
        specifications = [
            one for one in compiled.specifications if any(event.channel == channel for event in one.events)
        ]
        error = module.refused.get(channel)
        if error is not None:
            paths[SlowPath(channel, "", _position(compiled, channel, error), error.reason)] = None
            continue
        sliced = [specification for specification in specifications if specification.slicing is not None]
        for one in sliced:
            paths[SlowPath(channel, "", one.position, "has a parametric specification")] = None
        for one in specifications if not sliced else ():
            paths |= dict.fromkeys(_partly(compiled, module.left, channel, one))
    return list(paths)


def _partly(
    compiled: Compiled,
    left: Mapping[str, Sequence[NotCompiledError]],
    channel: str,
    specification: SpecificationCode,
) -> Iterator[SlowPath]:
    codes = [
        (f"event {specification.name}.{event.name}", event.function)
        for event in specification.events
        if event.channel == channel
    ]
    codes += [
        (f"handler @{category} of {specification.name}", code.handlers[category])
        for code in specification.properties
        for category in code.order
        if isinstance(code.property, FiniteProperty)
    ]
    for code, function in codes:
        for name in _called(compiled, function):
            for error in left.get(name, ()):
                yield SlowPath(channel, code, _position(compiled, channel, error), error.reason)
    for declared in specification.properties:
        reason = _of_property(declared)
        if reason:
            source = declared.property.source
            yield SlowPath(channel, f"{source.logic} property of {specification.name}", source.origin, reason)


def _of_property(code: PropertyCode) -> str:
    if isinstance(code.property, FiniteProperty):
        return ""
    if isinstance(code.property, ClockedProperty):
        return "runs a handler of a property with time bounds" if code.order else ""
    return "steps a property without a finite automaton"


def _called(compiled: Compiled, function: str) -> list[str]:
    names = [function]
    for name in names:
        body = compiled.functions[name].body if name in compiled.functions else ()
        for node in nodes.walk(body):
            called = node.function if isinstance(node, nodes.Invoke) else ""
            if isinstance(node, nodes.Skipper):
                called = node.name
            if called and called not in names:
                names.append(called)
    return names


def _position(compiled: Compiled, channel: str, error: NotCompiledError) -> Position:
    if error.site >= 0:
        return compiled.sites[error.site].position
    return next(
        event.position for one in compiled.specifications for event in one.events if event.channel == channel
    )
