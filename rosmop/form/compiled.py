"""A compiled set of specifications as data: the compiler writes it, and the engine runs it."""

import struct
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from rosmop.form import nodes
from rosmop.form.findings import Diagnostic, Position
from rosmop.form.sites import Site, Symbols
from rosmop.logics.interface import CompiledProperty
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes
from rosmop.types.value_types import Type

# Group items that are connected, directly or indirectly.


def sharing(uses: Mapping[str, Collection[str]]) -> list[set[str]]:
    """Group specifications; `uses` maps each to those whose variables it uses."""
    names = list(uses)
    return [
        {names[number] for number in group} for group in components([(name, *uses[name]) for name in names])
    ]


def components(keys: Sequence[Iterable[object]]) -> Iterable[Sequence[int]]:
    owners: dict[object, int] = {}
    chief = list(range(len(keys)))

    def find(number: int) -> int:
        while chief[number] != number:
            chief[number] = number = chief[chief[number]]
        return number

    for number, own in enumerate(keys):
        for key in own:
            chief[find(number)] = find(owners.setdefault(key, number))
    together: dict[int, list[int]] = {}
    for number in range(len(keys)):
        together.setdefault(find(number), []).append(number)
    return together.values()


def channel_of(service: str, part: str) -> str:
    """Return the name of a part of a service in place of a topic. It contains a blank, which no topic does."""
    return f"{service} {part}"


@dataclass(frozen=True)
class EventCode:
    """A compiled event: its function and its trigger.

    For an event of a service, `type` is the type of the request or response, and `service_type` that of the
    service.
    """

    name: str
    function: str
    position: Position
    topic: str | None = None
    type: str | None = None
    part: str | None = None
    service_type: str | None = None
    period_ns: int | None = None
    binds: tuple[int, ...] = ()
    key: str = ""
    creates: bool = False
    plain: bool = False
    """The key alone decides: there is neither an action nor a `when`."""
    acts: bool = False
    each_node: bool = False
    """It happens with the message of any node, and its action asks which one, in a specification that lists names: each
    node has a say of its own."""

    @property
    def channel(self) -> str | None:
        return self.topic if self.topic is None or self.part is None else channel_of(self.topic, self.part)


@dataclass(frozen=True)
class Comparison:
    """A comparison whose closest true and closest false results are noted in variables.

    `when_true` and `when_false` name the variables (double) for the left and the right side; the left one is
    infinite until the comparison is evaluated. `threshold` is the constant side (0: left, 1: right), if any.
    """

    position: Position
    threshold: int | None
    when_true: tuple[str, str]
    when_false: tuple[str, str]

    @property
    def variables(self) -> tuple[str, ...]:
        return (*self.when_true, *self.when_false)


@dataclass(frozen=True)
class Withholding:
    """A topic that hosts in `networks` do not receive while a variable is true; `condition` is its name in the form."""

    topic: str
    networks: tuple[str, ...]
    condition: str


@dataclass(frozen=True)
class Publication:
    """A topic that a specification publishes or a service that it calls, and the position of the statement.

    If it is `safe`, only the topic's safe message is published.
    """

    specification: str
    topic: str
    type: str
    position: Position
    safe: bool = False


@dataclass(frozen=True)
class Given:
    """A constant that operators may set. `code` is its name in the form; a `bool` has no bounds."""

    name: str
    code: str
    type: value_types.Type
    unit: str
    default: bool | int | float
    bounds: tuple[int | float, int | float] | None

    def holds(self, value: object) -> bool:
        if self.bounds is None or isinstance(value, bool):
            return self.bounds is None and isinstance(value, bool)
        fits = isinstance(value, int) or (
            isinstance(value, float) and isinstance(self.type, value_types.FloatingType)
        )
        return fits and self.bounds[0] <= value <= self.bounds[1]  # type: ignore[operator]  # a number

    def to_type(self, value: Any) -> bool | int | float:
        if not isinstance(self.type, value_types.FloatingType):
            return value  # type: ignore[no-any-return]  # a number
        return float(value) if self.type.bits == 64 else struct.unpack("<f", struct.pack("<f", value))[0]


@dataclass(frozen=True)
class GivenTopic:
    """A topic that operators may replace when they load the set; `name` is its name in the text."""

    name: str
    topic: str
    default: str


@dataclass(frozen=True)
class Slicing:
    """The parameters of slices (name in the text, name in the code, type), and the variables of each slice.

    A specification `enforces` if it drops, changes or publishes messages.
    """

    parameters: tuple[tuple[str, str, value_types.Type], ...]
    own: tuple[str, ...]
    enforces: bool


@dataclass(frozen=True)
class RemedyCode:
    """The function that publishes the due message of a property at its deadline.

    It must cause the event with the number `event`, whose pattern and `when` are the function `accepts`, which
    returns whether they fit a message.
    """

    name: str
    function: str
    event: int
    accepts: str


@dataclass(frozen=True)
class PropertyCode:
    """A compiled property, and the function of the handler for each handled category.

    `enforcement` describes how a violation can be prevented.
    """

    property: CompiledProperty
    handlers: Mapping[str, str]
    order: tuple[str, ...]
    enforcement: str
    remedy: RemedyCode | None = None


@dataclass(frozen=True)
class SpecificationCode:
    """A compiled specification. `variables` maps shared variables to their names in the code.

    `start` lists the functions that initialise it: constants and zeros, first values, `init`.
    """

    name: str
    position: Position
    identity: bytes
    """A hash of the text that ignores positions."""
    reached: frozenset[str]
    file: str
    hold: bool
    start: tuple[str, ...]
    context: str
    events: tuple[EventCode, ...]
    properties: tuple[PropertyCode, ...]
    variables: Mapping[str, str]
    uses: frozenset[str]
    comparisons: tuple[Comparison, ...] = ()
    slicing: Slicing | None = None
    begins: bool = False
    safes: tuple[nodes.SafeMessage, ...] = ()
    givens: tuple[Given, ...] = ()
    given_topics: tuple[GivenTopic, ...] = ()
    ordered: bool = False
    withholdings: tuple[Withholding, ...] = ()
    acts_on: tuple[str, ...] = ()
    """The channels of its events whose messages it may drop, change, replace, withhold or publish.

    It only observes the others. While it cannot judge, it holds these channels.
    """
    switch: Literal["on", "shadow", "off", ""] = ""
    """How it begins where it is not known, or empty: as the robot's setting says. It decides nothing in the engine."""


@dataclass(eq=False)
class Compiled:
    """A set of specifications; functions and types of variables are by name."""

    specifications: tuple[SpecificationCode, ...]
    warnings: tuple[Diagnostic, ...]
    functions: Mapping[str, nodes.Function]
    sites: Sequence[Site]
    types: Mapping[str, Type]
    messages: MessageTypes
    publications: tuple[Publication, ...]
    calls: tuple[Publication, ...] = ()

    def alone(self, names: Collection[str]) -> "Compiled":
        part = self.part(names)
        functions = {name: each for name, each in self.functions.items() if Symbols.owner(name) in names}
        safes = tuple(specification.safes for specification in part.specifications)
        sites = sorted(nodes.sites_of((*functions.values(), safes)))
        numbers = {-1: -1} | {site: number for number, site in enumerate(sites)}
        return replace(
            part,
            specifications=tuple(
                replace(one, safes=nodes.with_sites(one.safes, numbers)) if one.safes else one
                for one in part.specifications
            ),
            warnings=(),
            functions={name: nodes.with_sites(function, numbers) for name, function in functions.items()},
            sites=[self.sites[site] for site in sites],
            types={name: kind for name, kind in self.types.items() if Symbols.owner(name) in names},
        )

    def groups(self, names: Collection[str]) -> list[set[str]]:
        uses = {specification.name: specification.uses for specification in self.specifications}
        return [group for group in sharing(uses) if not group.isdisjoint(names)]

    def without(self, names: Collection[str]) -> "Compiled":
        gone = {name for group in self.groups(names) for name in group}
        return self.part({specification.name for specification in self.specifications} - gone)

    def part(self, names: Collection[str]) -> "Compiled":
        """`names` must include all specifications that share variables with one of them."""
        return replace(
            self,
            specifications=tuple(one for one in self.specifications if one.name in names),
            publications=tuple(one for one in self.publications if one.specification in names),
            calls=tuple(call for call in self.calls if call.specification in names),
        )

    def is_stamped(self, message_type: str | None) -> bool:
        fields = self.messages.definitions.message(message_type).fields if message_type is not None else ()
        return bool(fields) and fields[0].notation == "std_msgs/Header"

    @property
    def stamped(self) -> frozenset[str]:
        events = [
            event
            for specification in self.specifications
            for event in specification.events
            if event.part is None
        ]
        return frozenset(event.topic for event in events if event.topic and self.is_stamped(event.type))
