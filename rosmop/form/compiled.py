"""A compiled set of specifications as data: what the compiler writes, and what runs it reads."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from rosmop.form import nodes
from rosmop.form.connected_groups import sharing, way_of
from rosmop.form.positions import Finding, Position
from rosmop.form.sites import Site, Symbols
from rosmop.logics.interface import CompiledProperty
from rosmop.types import value_types
from rosmop.types.messages import Messages
from rosmop.types.value_types import Type


@dataclass(frozen=True)
class EventCode:
    """A compiled event: the name of its function, and what makes it happen.

    `type` is the message type (of a service: that of the request or response), `service_type` the service's.
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
    """The parameters of the specification that it binds, by their numbers."""
    key: str = ""
    """Of an event on messages of a parametric specification: its function for the values of these."""
    creates: bool = False
    """A slice may begin with it."""
    plain: bool = False
    """Where its key is known it has happened, and there is nothing to do."""
    acts: bool = False
    """Its action does more than to change the slice's own variables."""

    @property
    def way(self) -> str | None:
        """What its messages come on: the topic, or the part of a service (see `way_of`); None of a timer."""
        return self.topic if self.topic is None or self.part is None else way_of(self.topic, self.part)


@dataclass(frozen=True)
class Comparison:
    """A comparison of a specification. `when_true` and `when_false` are variables of the code (double) for its sides.

    The left one is infinite until it came up. `threshold`: the side that is a constant, 0 or 1; None if neither is.
    """

    position: Position
    threshold: int | None
    when_true: tuple[str, str]
    when_false: tuple[str, str]

    @property
    def variables(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.when_true, *self.when_false)


@dataclass(frozen=True)
class Publication:
    """A topic that a specification publishes, and where it says so."""

    specification: str
    topic: str
    type: str
    position: Position


@dataclass(frozen=True)
class Slicing:
    """What slices differ in: the parameters (name in the text, name in the code, type), and their own variables.

    `enforces`: the specification drops or changes messages, or publishes some.
    """

    parameters: tuple[tuple[str, str, value_types.Type], ...]
    own: tuple[str, ...]
    enforces: bool


@dataclass(frozen=True)
class PropertyCode:
    """A compiled property: its monitor, and for each category that is handled the name of the function.

    `enforcement` says whether and how a violation can be prevented.
    """

    property: CompiledProperty
    handlers: Mapping[str, str]
    order: tuple[str, ...]
    enforcement: str


@dataclass(frozen=True)
class SpecificationCode:
    """A compiled specification. `variables` are its shared variables: name in the text to name in the code.

    `start` are the functions by which it begins: constants and zeros, first values, `init`.
    """

    name: str
    position: Position
    identity: bytes
    """The same for the same text, wherever it stands."""
    reached: frozenset[str]
    """The message types that it names, and those they are made of (`reach.py`)."""
    file: str
    hold: bool
    start: tuple[str, ...]
    context: str
    events: tuple[EventCode, ...]
    properties: tuple[PropertyCode, ...]
    variables: Mapping[str, str]
    uses: frozenset[str]
    """The other specifications whose variables it uses."""
    comparisons: tuple[Comparison, ...] = ()
    """The comparisons that are noted, in the order of the text."""
    slicing: Slicing | None = None
    """Of a parametric specification: what its slices differ in."""
    begins: bool = False
    """Declared `begin`: where its state is lost it begins again and does not hold its topics."""


@dataclass(eq=False)
class Compiled:
    """A set of specifications: their functions in the intermediate form, by name, and what is in them."""

    specifications: tuple[SpecificationCode, ...]
    warnings: tuple[Finding, ...]
    functions: Mapping[str, nodes.Function]
    sites: Sequence[Site]
    types: Mapping[str, Type]
    """Those of variables, by their names in the form."""
    messages: Messages
    publications: tuple[Publication, ...]

    def alone(self, names: Collection[str]) -> "Compiled":
        """As `part`, without anything of the others: the same whatever else is in the set."""
        part = self.part(names)
        functions = {name: each for name, each in self.functions.items() if Symbols.owner(name) in names}
        found = [node for function in functions.values() for node in nodes.walk(function)]
        sites = sorted({node.site for node in found if hasattr(node, "site")} - {-1})
        numbers = {-1: -1} | {site: number for number, site in enumerate(sites)}
        return replace(
            part,
            warnings=(),
            functions={name: nodes.moved(function, numbers) for name, function in functions.items()},
            sites=[self.sites[site] for site in sites],
            types={name: kind for name, kind in self.types.items() if Symbols.owner(name) in names},
        )

    def groups(self, names: Collection[str]) -> list[set[str]]:
        """Those that share variables, however indirectly, with one of these."""
        uses = {one.name: one.uses for one in self.specifications}
        return [group for group in sharing(uses) if not group.isdisjoint(names)]

    def without(self, names: Collection[str]) -> "Compiled":
        """All but these, and those that share variables with them."""
        gone = {name for group in self.groups(names) for name in group}
        return self.part({one.name for one in self.specifications} - gone)

    def part(self, names: Collection[str]) -> "Compiled":
        """These of the specifications only; all that share variables with one of them must be among them."""
        return replace(
            self,
            specifications=tuple(one for one in self.specifications if one.name in names),
            publications=tuple(one for one in self.publications if one.specification in names),
        )

    def is_stamped(self, message_type: str | None) -> bool:
        """Whether messages of a type begin with a `std_msgs/Header`."""
        fields = self.messages.definitions.message(message_type).fields if message_type is not None else ()
        return bool(fields) and fields[0].notation == "std_msgs/Header"

    @property
    def stamped(self) -> frozenset[str]:
        """The topics whose messages do."""
        events = [
            event
            for specification in self.specifications
            for event in specification.events
            if event.part is None
        ]
        return frozenset(event.topic for event in events if event.topic and self.is_stamped(event.type))
