"""Writes, for each topic, functions that take as many messages of a batch as need nothing but the common.

A message goes through the engine in one to three microseconds, most of which are calls and objects that nobody looks
at. So the events on a topic are written once more, all into one loop over the frames of a receive buffer
(`compile/inline.py`): fields read at offsets, actions in line, properties looked up in their tables, numbers written
in place. There are two forms of the loop:

- `alone`: frame by frame, whatever their lengths;
- `alike`: frames of one length whose strings and arrays have the lengths of the first (`compile/shapes.py`), read by
  one `struct.iter_unpack`.

The loop stops before a message that needs more: output, a fault, a verdict that is handled, a value of another size,
a drop or change that is to be told in full. What it did to that message is taken back, and the engine handles it from
the beginning; so there is one meaning, the engine's, and nothing in the loop explains, records or reports.
`rosmop/batch.py` calls the loops, and says when they may be called at all.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from appliance.rosmop.compile.events import EventCode
from appliance.rosmop.compile.harmless import Harmless
from appliance.rosmop.compile.inline import Body, Column, EventSource, Inliner, NotInlineError
from appliance.rosmop.compile.module import Module
from appliance.rosmop.compile.shapes import Shape
from appliance.rosmop.compile.specification import SpecificationCode
from appliance.rosmop.logics.interface import FiniteProperty

MAX_STATES = 10_000
"""Larger tables are left to the engine."""


@dataclass(frozen=True)
class BatchEvent:
    """An event in a loop: that of the specification with this number, its own number there, and its name."""

    specification: int
    event: int
    name: str


@dataclass(frozen=True)
class BatchCode:
    """The loops of one topic: the names of their functions.

    `events` are in the order in which a message meets them; `specifications` and `properties` (specification,
    property) are what the loops are handed. `droppers` and `writers` are the events that may drop or change.
    """

    topic: str
    events: tuple[BatchEvent, ...]
    specifications: tuple[int, ...]
    properties: tuple[tuple[int, int], ...]
    alone: str
    alike: str | None
    shape: Shape | None
    droppers: frozenset[int]
    writers: frozenset[int]


def batches(module: Module, specifications: Sequence[SpecificationCode]) -> Iterator[tuple[BatchCode, str]]:
    """The loops of every topic that can have them, each with its source, to be run in the module's namespace."""
    topics: dict[str, list[tuple[int, int, EventCode]]] = {}
    for number, specification in enumerate(specifications):
        for index, event in enumerate(specification.events):
            if event.topic is not None and event.part is None:
                topics.setdefault(event.topic, []).append((number, index, event))
    harmless = Harmless(module)
    for topic, events in topics.items():
        writer = _Writer(module, harmless, specifications, topic, events)
        try:
            code = writer.code()
        except (NotInlineError, RecursionError):
            continue
        yield code, "\n".join(writer.sources) + "\n"


class _Writer:
    """Writes the loops of one topic."""

    def __init__(
        self,
        module: Module,
        harmless: Harmless,
        specifications: Sequence[SpecificationCode],
        topic: str,
        events: Sequence[tuple[int, int, EventCode]],
    ) -> None:
        self._module = module
        self._harmless = harmless
        self._specifications = specifications
        self._topic = topic
        self._numbers = tuple(dict.fromkeys(number for number, _, _ in events))
        self._properties: list[tuple[int, int]] = []
        self._events = tuple(
            BatchEvent(number, index, f"{specifications[number].name}.{event.name}")
            for number, index, event in events
        )
        self._sources = [
            self._source(place, number, index, event) for place, (number, index, event) in enumerate(events)
        ]
        self.sources: list[str] = []

    def code(self) -> BatchCode:
        """Write the loops; raises `NotInlineError` if the topic can have none."""
        alone = self._body(None)
        shape: Shape | None = Shape()
        try:
            alike = self._body(shape)
        except NotInlineError:
            shape = None
        names = [self._loop(alone)] + ([self._loop(alike)] if shape is not None else [])
        return BatchCode(
            self._topic,
            self._events,
            self._numbers,
            tuple(self._properties),
            names[0],
            names[1] if shape is not None else None,
            shape,
            frozenset(alone.droppers),
            frozenset(alone.writers),
        )

    def _source(self, place: int, number: int, index: int, event: EventCode) -> EventSource:
        guard = f"e_{self._numbers.index(number)}" if len(self._numbers) > 1 else None
        columns = []
        for each, code in enumerate(self._specifications[number].properties):
            table: tuple[int, ...] = (-1,)
            if isinstance(code.property, FiniteProperty) and len(code.property.automaton) <= MAX_STATES:
                automaton = code.property.automaton
                handled = [bool(set(code.order) & set(verdict)) for verdict in automaton.verdicts]
                table = tuple(-1 if handled[row[index]] else row[index] for row in automaton.table)
                if (number, each) not in self._properties:
                    self._properties.append((number, each))
            variable = (
                f"s_{self._properties.index((number, each))}" if (number, each) in self._properties else ""
            )
            columns.append(Column(variable, table))
        return EventSource(place, self._module.function(event.function) or "", tuple(columns), guard)

    def _body(self, shape: Shape | None) -> Body:
        body = Body(self._module, shape, len(self._events) > 1)
        for event in self._sources:
            Inliner(body, self._harmless, event).write(3)
        return body

    def _loop(self, body: Body) -> str:
        """The function around the lines of the events."""
        name = self._module.fresh("b")
        states = [f"s_{number}" for number in range(len(self._properties))]
        kept = ["undo = ()", "who = 0"] if self._undone(body) else []
        before = {**{f"z_{one}": one for one in sorted(body.shared)}}
        if body.several:
            counted = [f"n_{number}" for number in range(len(self._events))]
            before |= {f"z_{one}": one for one in [*states, *counted]}
        snapshot = [*(f"{copy} = {one}" for copy, one in before.items()), *kept]
        restore = [f"{one} = {copy}" for copy, one in before.items()]
        if self._undone(body):
            restore.append("for i, t, a, o, _ in undo[::-1]: i(t, a, o)")
        lines = [
            *self._head(name, body, states),
            *(f"    {line}" for line in snapshot),
            "    stopped = True",
            "    try:",
            *self._walk(body),
            *(f"            {line}" for line in [*snapshot, *self._guards(body)]),
            *body.lines,
            *(f"            {line}" for line in self._tail(body)),
            "        else:",
            f"            {'position = end' if body.shape is None else 'position += stride'}",
            "            stopped = False",
            "    except x_exception:",
            "        pass",
            *(["    if stopped:", *(f"        {line}" for line in restore)] if restore else []),
            *(["    n_0 = (position - start) // stride"] if body.always else []),
            *(f"    p_{number}.state = {state}" for number, state in enumerate(states)),
            *(["    if again: changes.append((same, again))"] if self._undone(body) else []),
            f"    return {self._result(body)}",
        ]
        self.sources += lines
        return name

    def _head(self, name: str, body: Body, states: Sequence[str]) -> list[str]:
        frames = "" if body.shape is None else ", frames, stride, lengths, places"
        numbers = range(len(self._events))
        lines = [f"def {name}(view, position, end, run, pieces, loud, told, enabled, runs{frames}):"]
        if body.shared:
            lines.append(f"    global {', '.join(sorted(body.shared))}")
        if len(self._numbers) > 1:
            lines.append(f"    {_names('e', len(self._numbers))} = enabled")
        if states:
            lines.append(f"    {_names('p', len(states))} = runs")
            lines += [f"    {state} = p_{number}.state" for number, state in enumerate(states)]
        if body.droppers:
            lines.append(f"    {_names('k', len(numbers))} = told")
        if body.shape is not None:
            if body.shape.lengths:
                lines.append(f"    {_names('m', len(body.shape.lengths))} = lengths")
            if body.shape.written:
                lines.append(f"    {_names('o', len(body.shape.written))} = places")
        if body.always:
            lines.append("    start = position")
        lines += [f"    n_{number} = x_{number} = 0" for number in numbers]
        if not body.several:
            lines.append("    y_0 = 0")
        if self._undone(body):
            lines.append("    changes = []")
            lines.append("    same = again = 0")
        lines.append("    following = position" if body.shape is None else "    position -= stride")
        return lines

    def _walk(self, body: Body) -> list[str]:
        """From one frame to the next."""
        if body.shape is not None:
            names = ", ".join(name for _, _, name in body.shape.items)
            each = f"{names}," if names else "_"
            return [
                f"        for {each} in frames:",
                "            position += stride",
            ]
        length = self._module.struct("<I", "unpack_from")
        return [
            "        while following < end:",
            "            position = following",
            f"            following += 4 + {length}(view, position)[0]",
            "            b = view[position + 4:following]",
        ]

    def _guards(self, body: Body) -> list[str]:
        """Leave where a message is of another shape."""
        if body.shape is None or not body.shape.lengths:
            return []
        asked = " or ".join(f"l_{number} != m_{number}" for number in range(len(body.shape.lengths)))
        return [f"if {asked}: break"]

    def _tail(self, body: Body) -> list[str]:
        """The message has met all events and goes on."""
        if not self._undone(body):
            return []
        return [
            "if who:",
            *(["    if who & who - 1 and x_repeated(undo): break"] if len(body.writers) > 1 else []),
            "    if who == same: again += 1",
            "    else:",
            "        if again: changes.append((same, again))",
            "        same = who",
            "        again = 1",
        ]

    def _undone(self, body: Body) -> bool:
        return body.several and bool(body.writers)

    def _result(self, body: Body) -> str:
        numbers = range(len(self._events))
        counts = [", ".join(f"{letter}_{number}" for number in numbers) for letter in "nx"]
        changes = "()"
        if body.writers:
            changes = "changes" if body.several else "((1, y_0),) if y_0 else ()"
        return f"position, run, ({counts[0]},), ({counts[1]},), {changes}"


def _names(letter: str, count: int) -> str:
    return ", ".join(f"{letter}_{number}" for number in range(count)) + ","
