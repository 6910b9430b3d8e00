"""The module of an event does what the interpreter does: what happened, bytes, variables, faults; and has bounds."""

import struct
from collections import Counter
from typing import Any

import pytest
import wasmtime
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.rosmop.compile.events import EventCode
from appliance.rosmop.compile.specification import SpecificationCode
from appliance.rosmop.engine import MonitorSet
from appliance.rosmop.faults import explain
from appliance.rosmop.ir.interpreter import Stopped
from appliance.rosmop.ir.module import REASONS, NotScalarError, module_of
from appliance.rosmop.ir.values import Values
from appliance.rosmop.runtime.wire import Message
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type
from appliance.rosmop.types.messages import Messages as MessageTypes
from tests.unit.rosmop.interpreted import beside
from tests.unit.rosmop.random_specifications import TOPICS, Messages, Specifications, definitions

AT = 4096
"""Where messages are put."""
FUEL = 100_000
FEW = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


class Pair:
    """An event run by the interpreter and by its module, which is handed the interpreter's variables."""

    def __init__(self, monitors: MonitorSet, specification: SpecificationCode, event: EventCode) -> None:
        self._compiled = monitors._compiled
        self._event = event
        self._context = self._compiled.namespace[specification.context]
        self._values = Values(MessageTypes(monitors.definitions))
        shared = {code for one in self._compiled.specifications for code in one.variables.values()}
        module = module_of(self._compiled.functions, [event.function], frozenset(shared))
        self._addresses = module.addresses
        config = wasmtime.Config()
        config.consume_fuel = True
        engine = wasmtime.Engine(config)
        self.store = wasmtime.Store(engine)
        self.store.set_limits(memory_size=65536)
        exports = wasmtime.Instance(self.store, wasmtime.Module(engine, module.code), []).exports(self.store)
        self._memory: Any = exports["memory"]
        self._function: Any = exports[event.function]

    def check(self, body: bytes) -> str:
        """Fail if a message makes a difference; what came of it."""
        self._memory.write(self.store, body, AT)
        for name, (address, kind) in self._addresses.items():
            raw = struct.pack(_code(kind), _signed(kind, self._compiled.namespace[name]))
            self._memory.write(self.store, raw, address)
        message = Message(bytearray(body), 0)
        self._context.begin()
        expected = self._interpret(message)
        assert self._run(len(body)) == expected
        if isinstance(expected, bool) and not message.dropped:
            assert self._told(bytes(message.buffer)) == self._told(
                self._memory.read(self.store, AT, AT + len(body))
            )
        for name, (address, kind) in self._addresses.items():
            found = struct.unpack(_code(kind), self._memory.read(self.store, address, address + _size(kind)))[
                0
            ]
            assert repr(_signed(kind, self._compiled.namespace[name])) == repr(found), name
        return (
            "fault"
            if not isinstance(expected, bool)
            else "dropped"
            if message.dropped
            else "changed" * message.touched
        )

    def _interpret(self, message: Message) -> bool | tuple[int, str]:
        try:
            happened = self._compiled.namespace[self._event.function](message)
        except Stopped as stopped:
            text = explain(stopped, self._compiled.module, "", self._event.position).text
            return stopped.site, text.partition(":")[0]
        self.dropped = message.dropped
        return bool(happened)

    def _run(self, size: int) -> bool | tuple[int, str]:
        self.store.set_fuel(FUEL)
        try:
            bits = self._function(self.store, AT, size)
        except wasmtime.Trap:
            site, reason = struct.unpack("<ii", self._memory.read(self.store, 0, 8))
            return site, REASONS[reason]
        assert bool(bits & 2) == self.dropped
        return bool(bits & 1)

    def _told(self, body: bytes) -> str:
        """The message as text: a NaN is one, whatever its bits."""
        kind = kinds.Record(TOPICS[self._event.topic or ""])
        try:
            return repr(self._values.decode(kind, body, 0))
        except Exception:  # noqa: BLE001  not a message of its type: the bytes themselves
            return repr(bytes(body))


def _size(kind: Type) -> int:
    return struct.calcsize(_code(kind))


def _code(kind: Type) -> str:
    """The `struct` code of a variable in the module's memory."""
    if isinstance(kind, kinds.Floating):
        return "<f" if kind.bits == 32 else "<d"
    return (
        "<i"
        if isinstance(kind, kinds.Bool) or (isinstance(kind, kinds.Integer) and kind.bits <= 32)
        else "<q"
    )


def _signed(kind: Type, value: Any) -> Any:
    """A value as the signed number with the same bits."""
    if isinstance(kind, kinds.Floating):
        return value
    half = 1 << 8 * _size(kind) - 1
    return (int(value) + half) % (2 * half) - half


def pairs(sources: dict[str, str]) -> list[tuple[str, Pair]]:
    """The events that have modules, each with its topic; the monitors have begun. None of a draw that means nothing."""
    try:
        monitors = beside(MonitorSet.load(sources, definitions()))
    except SpecificationError:
        return []
    monitors.start(0)
    found = []
    for specification in monitors._compiled.specifications:
        for event in specification.events:
            if event.topic is not None:
                try:
                    found.append((event.topic, Pair(monitors, specification, event)))
                except NotScalarError:
                    continue
    return found


@FEW
@given(seed=st.integers(0, 1 << 30), wild=st.binary(max_size=80))
def test_random_events_and_messages(seed: int, wild: bytes) -> None:
    """Actions, conditions, helper functions, loops, fields behind strings; messages and bytes that are none."""
    messages = Messages(seed)
    traffic = [messages.traffic() for _ in range(4)]
    for topic, pair in pairs(
        {f"{place}.rv": text for place, text in enumerate(Specifications(seed).texts())}
    ):
        for body in [body for one in traffic if one.topic == topic for body in one.bodies()]:
            pair.check(body)
        pair.check(wild)


def test_most_random_events_have_modules_and_everything_comes_up() -> None:
    """What the comparison above compares is not nothing."""
    came: Counter[str] = Counter()
    for seed in range(12):
        messages = Messages(seed)
        traffic = [messages.traffic() for _ in range(6)]
        for topic, pair in pairs({f"{n}.rv": text for n, text in enumerate(Specifications(seed).texts())}):
            came["events"] += 1
            came.update(pair.check(body) for one in traffic if one.topic == topic for body in one.bodies())
    assert came["events"] > 20
    assert min(came[what] for what in ("fault", "dropped", "changed", "")) > 10


EXPRESSIONS = (
    "x % 7", "-x / 3", "x << 33", "(unsigned int) x >> 1", "~x", "abs(x)", "(int8_t) x", "(uint16_t) x", "(int) y",
    "(uint8_t) y", "(unsigned long) y", "(float) x", "(long) y * x", "x ? y : 1", "x == y", "x && y", "!x || y < 0",
    "std::max(x, 7)", "std::min(y, 0.5)", "(x += 2) + x++", "(unsigned int) x < 5u", "x / (x - x)", "y / 0", "x ^ 5L",
)  # fmt: skip


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_expressions_at_the_limits(expression: str) -> None:
    """Numbers that overflow, do not fit, or are none."""
    text = f"""s() {{ double d = 0; long n = 0; float f = 0;
    event e(int x, double y) /plain own/Plain '{{count:x, x:y}}' {{ d = {expression}; n = d; f = d; x = n; }} }}"""
    ((_, pair),) = pairs({"x.rv": text})
    for x in (0, 1, -1, 7, 2**31 - 1, -(2**31)):
        for y in (0.0, -0.0, 0.5, -2.5, 300.0, 1e300, -1e300, float("inf"), float("nan"), 2.0**63):
            pair.check(struct.pack("<BidfBII3qI", 1, x, y, 0.0, 0, 0, 0, 0, 0, 0, 0))


def test_a_loop_without_end_ends() -> None:
    """The runtime stops it when the fuel is used up."""
    text = "s() { int n = 0; event e() /plain own/Plain '{}' { while (true) { n++; } } }"
    ((_, pair),) = pairs({"x.rv": text})
    pair.store.set_fuel(FUEL)
    with pytest.raises(wasmtime.Trap, match="fuel"):
        pair._function(pair.store, AT, 0)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ('ROS_INFO("x");', "Log"),
        ("std::string s;", "std::string"),
        ("n = down(3);", "recursion"),
        ("v.push_back(1);", "l_append"),
    ],
)
def test_what_is_beyond_this_part_is_named(body: str, reason: str) -> None:
    """And not written in another way."""
    text = f"""s() {{ int n = 0; std::vector<int> v; int down(int i) {{ return i ? down(i - 1) : 0; }}
    event e() /plain own/Plain '{{}}' {{ {body} }} }}"""
    compiled = MonitorSet.load({"x.rv": text}, definitions())._compiled
    (specification,) = compiled.specifications
    with pytest.raises(NotScalarError, match=reason):
        module_of(
            compiled.functions,
            [specification.events[0].function],
            frozenset(specification.variables.values()),
        )
