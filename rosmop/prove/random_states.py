"""Draw states and messages in which an event may behave wrongly, from a fixed seed.

All values of a state are drawn from few numbers, so that many of them are equal: the constants of the event, those of
the specification, their neighbours, and sums with the time. Half of the states are *tame*: nearly all numbers are
small, and in half of these they are multiples of a half, so that a sum is exactly at a bound. Half of the states
follow from the state before, as they do on a robot: with another message, or with the same one in which few numbers
differ.
"""

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random

from rosmop.fast.abi import most_kept
from rosmop.fast.batch_codegen import WasmModule
from rosmop.form import nodes
from rosmop.form.compiled import Compiled
from rosmop.prove.concrete_runs import ConcreteRuns, EventPair, EventState
from rosmop.runtime.action_context import BUDGET
from rosmop.runtime.times import MAX_TIME
from rosmop.runtime.values import ValueCodec, struct_code
from rosmop.types import value_types
from rosmop.types.value_types import Type, Value

STATES = 4000
"""The number of states for each event."""

_SEED = 1
_NOT_FINITE = (math.nan, math.inf, -math.inf)
_FLOATS = (0.0, -0.0, 0.5, 1.0, -1.0, 2.5, 1e-3, 1e300, -1e300, 5e-324, math.nan, *_NOT_FINITE)
_TIMES = (0, 10**9, 10 * 10**9, 1_700_000_000 * 10**9)
_TEXTS = (b"", b"a", b"b", b"abc", b"x" * 65)
_TAME = 1e6
_LONG = range(17, 5001)
"""Constants that may be lengths of long arrays."""
_SELDOM = 125
"""Two of this number of states have long arrays, which take time."""


class _Constants:
    """The `numbers` and `texts` of an event and of the functions that it calls, and `bounds` of its specification."""

    def __init__(self, numbers: Sequence[float], texts: Sequence[bytes], bounds: Sequence[float]) -> None:
        self.texts = texts
        self.floats = [*_FLOATS, *numbers, *bounds]
        self.literals = [number for number in numbers if abs(number) < _TAME] or [0.0]
        self.integers = [int(literal) for literal in self.literals if literal == int(literal)] or [0]
        self.longest = max((int(one) for one in self.floats if one in _LONG), default=0)


@dataclass
class _Traits:
    """The common traits of the values of a state: a `few` numbers and `names`; `is_exact`: multiples of a half."""

    few: Sequence[float] = ()
    names: Sequence[bytes] = ()
    is_tame: bool = False
    is_exact: bool = False


class RandomStates:
    """Draws states of one event."""

    def __init__(self, compiled: Compiled, module: WasmModule, event: EventPair) -> None:
        self._random = Random(_SEED)  # noqa: S311  draws examples, not keys
        self._compiled, self._kind, self._values = compiled, event.kind, ValueCodec(compiled.messages)
        self._kinds = {name: kind for own in module.cells for name, (_, kind) in own.variables.items()}
        givens = [given for specification in compiled.specifications for given in specification.givens]
        self._givens = {given.code: given.default for given in givens if given.code in self._kinds}
        self._throttles = [*module.throttles]
        bounds = [float(one) for given in givens for one in (given.default, *(given.bounds or ()))]
        self._constants = _Constants(*_constants(compiled, event.name), bounds)
        self._traits = _Traits()
        self._now = self._length = 0
        self._zeros = 0.0
        """The fraction of a message's numbers that are 0, as in the messages of a standing base."""
        self._fields: Value = []

    def following(self, runs: ConcreteRuns, event: EventPair) -> Iterator[EventState]:
        """Yield the states, in half of which the variables have the values after the state before."""
        state: EventState | None = None
        for number in range(STATES):
            turn = number % _SELDOM
            self._length = (
                self._constants.longest + self._random.randrange(2)
                if turn < 2 and self._constants.longest
                else 0
            )
            if state is None or turn == 0 or (turn > 1 and self._random.random() < 0.5):
                state = self._state()
            else:
                state = self._next(state, runs.after(event, state))
            yield state

    def _state(self) -> EventState:
        random = self._random
        self._traits.is_tame = bool(self._length) or random.random() < 0.5
        self._traits.is_exact = self._traits.is_tame and random.random() < 0.5
        self._now = random.choice(_TIMES) + random.choice((0, 0, 1, random.randrange(10**9)))
        few = [
            *random.choices(self._constants.floats, k=2),
            random.choice((random.uniform(-3, 3), random.choice(_FLOATS))),
        ]
        if self._traits.is_tame:
            few = [one if abs(one) < _TAME and self._fits(one) else self._small() for one in few]
        self._traits.few = [*few, random.choice(_NOT_FINITE)] if self._length else few
        self._traits.names = random.choices(self._constants.texts, k=2)
        variables = {name: self._value(kind) for name, kind in self._kinds.items()}
        if self._traits.is_tame:
            kept = random.choice((0.5, 1))
            variables |= {name: default for name, default in self._givens.items() if random.random() < kept}
        budget = BUDGET if self._traits.is_tame or random.random() < 0.6 else random.randrange(2000)
        last = [self._now, self._now - 1, 0, self._now + 1, (1 << 63) - 1, max(self._now - 10**9, 0)]
        throttled = {key: random.choice(last[:2] * 6 + last) for key in self._throttles}
        names, altered = (self._text(), self._text()), random.random() < 0.25
        return EventState(self._message(), self._now, variables, budget, throttled, names, altered)

    def _next(self, state: EventState, after: Mapping[str, Value]) -> EventState:
        random = self._random
        if random.random() < 0.4:
            message = self._message()
        else:  # the same message again, or with a few other numbers
            for _ in range(random.choice((0, 1, 1, 2))):
                self._fields = self._change(self._fields, self._kind)
            message = self._encode()
        self._now = state.now + random.choice((0, 10**6, 10**8))
        variables = {name: after[name] for name in self._kinds}
        for name in random.sample([*variables], k=min(len(variables), random.choice((0, 1, 1, 2)))):
            variables[name] = self._value(self._kinds[name])
        names = random.choice((state.names, (self._text(), self._text())))
        return replace(state, message=message, now=self._now, variables=variables, names=names)

    def _message(self) -> bytes:
        """Return a message; one of ten is too short or too long, or has a wrong length in it."""
        random = self._random
        self._zeros = random.choice((0.0, 0.75))
        self._fields = self._value(self._kind)
        self._zeros = 0.0
        raw, chance = bytearray(self._encode()), random.random()
        if chance < 0.04:
            del raw[random.randrange(len(raw) + 1) :]
        elif chance < 0.08 and len(raw) >= 4:
            length = random.choice((1, 5, 1 << 31, (1 << 32) - 1))
            struct.pack_into("<I", raw, random.randrange(len(raw) - 3), length)
        elif chance < 0.1:
            raw += bytes(random.randrange(1, 20))
        return bytes(raw)

    def _encode(self) -> bytes:
        raw = bytearray()
        self._values.encoder(self._kind)(self._fields, raw)
        return bytes(raw)

    def _change(self, value: Value, kind: Type) -> Value:
        """Return a copy of a value in which one number or string is drawn again."""
        random = self._random
        if isinstance(kind, value_types.FloatingType) and random.random() < 0.3:
            return random.choice(_NOT_FINITE)
        if not isinstance(value, list) or not value:
            return self._value(kind)
        lists = [place for place, inner in enumerate(value) if isinstance(inner, list) and inner]
        place = random.choice(lists if lists and random.random() < 0.5 else range(len(value)))
        if isinstance(kind, value_types.RecordType):
            inner = self._values.fields(kind)[place]
        else:
            assert isinstance(kind, value_types.VectorType)  # noqa: S101  only these two have lists as values
            inner = kind.element
        return [*value[:place], self._change(value[place], inner), *value[place + 1 :]]

    def _value(self, kind: Type) -> Value:
        random = self._random
        if isinstance(kind, value_types.RecordType):
            return [self._value(field) for field in self._values.fields(kind)]
        if isinstance(kind, value_types.VectorType):
            length = kind.length
            if length is None:
                most = most_kept(kind) if struct_code(kind.element) else 4
                length = min(self._length or random.choice((0, 1, 2, 2, 3, 4)), most)
            some = [self._value(kind.element) for _ in range(min(length, random.choice((1, 2, 4))))]
            return some if len(some) == length else random.choices(some, k=length)
        return self._text() if isinstance(kind, value_types.StringType) else self._number(kind)

    def _number(self, kind: Type) -> float:
        random = self._random
        if self._zeros and random.random() < self._zeros:
            return 0
        if isinstance(kind, value_types.BoolType):
            return random.random() < 0.5
        if isinstance(kind, value_types.FloatingType):
            value = self._float()
            return value if kind.bits == 64 else _single(value)
        some = random.choice((*self._traits.few, random.choice(self._constants.floats)))
        if isinstance(kind, value_types.IntegerType):
            near, literal = (
                _whole(some) + random.choice((0, 0, 1, -1)),
                random.choice(self._constants.integers),
            )
            value = random.choice(
                (near, near, -near, literal, literal, random.randrange(4), kind.least, kind.most)
            )
            return min(max(value, kind.least), kind.most)
        ago = _whole(some * 1e9) + random.choice((0, 0, 1, -1))
        value = random.choice((self._now - ago, self._now - ago, self._now, ago, 0))
        return min(max(value, 0 if kind == value_types.TIME else -MAX_TIME // 4), MAX_TIME // 4)

    def _float(self) -> float:
        random, few = self._random, self._traits.few
        seconds, value = self._now / 1e9, random.choice(few)
        if self._traits.is_tame:
            small, literal = self._small(), random.choice(self._constants.literals)
            return random.choice((value, value, small, small, literal, literal, seconds - value))
        chance = random.random()
        if chance < 0.45:
            return value
        if chance < 0.55:
            return math.nextafter(value, random.choice((math.inf, -math.inf)))
        if chance < 0.65:
            return random.choice((seconds, seconds - value, seconds + value))
        if chance < 0.75:
            return random.choice((-value, value * 2, value + random.choice(few), 1 / value if value else 0.0))
        if chance < 0.85:
            return random.choice(random.choice((_FLOATS, self._constants.literals, self._constants.floats)))
        return random.uniform(-1, 1) * 10 ** random.choice((0, 0, 0, 1, 3, -3))

    def _small(self) -> float:
        return self._random.randrange(-8, 9) / 2 if self._traits.is_exact else self._random.uniform(-3, 3)

    def _fits(self, value: float) -> bool:
        return not self._traits.is_exact or value * 2 == int(value * 2)

    def _text(self) -> bytes:
        return self._random.choice(
            (*self._traits.names, *self._traits.names, self._random.choice(self._constants.texts))
        )


def _constants(compiled: Compiled, function: str) -> tuple[Sequence[float], Sequence[bytes]]:
    """Return the numbers and the strings in an event and in the functions that it calls."""
    numbers, texts, reached = list[float](), [*_TEXTS], [function]
    for name in reached:
        for node in nodes.walk(compiled.functions[name].body):
            if isinstance(node, nodes.Invoke) and node.function not in reached:
                reached.append(node.function)
            elif isinstance(node, nodes.Literal) and isinstance(node.type, value_types.VectorType):
                code = struct_code(node.type.element) or ""
                if isinstance(node.value, bytes) and len(code) == 1:
                    numbers += [float(one) for (one,) in struct.iter_unpack(f"<{code}", node.value)]
            elif isinstance(node, nodes.Literal) and isinstance(node.value, bytes):
                texts.append(node.value)
            elif isinstance(node, nodes.Literal) and node.value is not None:
                numbers.append(float(node.value))
    return [*dict.fromkeys(numbers)], texts


def _whole(value: float) -> int:
    return int(value) if abs(value) < 1e30 else 0


def _single(value: float) -> float:
    single: float
    (single,) = struct.unpack("<f", struct.pack("<f", value)) if abs(value) < 3e38 else (value * math.inf,)
    return single
