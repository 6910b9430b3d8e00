"""Ask z3 whether the compiled code of an event can differ from its intermediate form (`form/nodes.py`).

Both are compared for every message of up to `AREA` bytes and every state. They are equal if the function
leaves the message to Python, which then processes it from the start, or if all of these hold:

- the form does not fault;
- both agree on whether the event happened, and dropped, replaced or changed the message;
- the message, the variables, the rest of the budget and the lines of output are the same.

Before z3 is asked, the interpreter and the module run the event in some states (`random_states.py`), and in many more
before z3 is asked about single conditions. A model of z3 is reported as a difference only if such a run shows it
(below).

Whether two strings in variables or names of senders are equal is left open, and an event that reads their bytes is
not proved. If the function leaves the message, each variable that it wrote must be among those that are restored, and
each byte in the log (`module_terms.py`).
"""

import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import z3

from rosmop.fast.abi import AREA, SENDER, is_kept, is_texts, kept_size, most_kept, room_of
from rosmop.fast.batch_codegen import WasmModule, write
from rosmop.form.compiled import Compiled, EventCode
from rosmop.form.specification_groups import groups
from rosmop.prove.concrete_runs import (
    BUDGET_ONLY,
    CHANGED,
    DROPPED,
    ELSEWHERE,
    HAPPENED,
    READS_BEYOND,
    REPLACED,
    ConcreteRuns,
    EventPair,
    EventState,
)
from rosmop.prove.decoding import functions_of
from rosmop.prove.event_terms import FormResult
from rosmop.prove.form_terms import FormTerms
from rosmop.prove.loops import BUDGET_SLOT, assumption, loop_conditions
from rosmop.prove.module_terms import LoopGuess, ModuleExecution, ModuleResult, Pointer, ReadableBytes
from rosmop.prove.number_terms import wrap
from rosmop.prove.questions import Effort, MayDifferError, Questions, first_difference
from rosmop.prove.random_states import STATES, RandomStates
from rosmop.prove.terms import (
    DOUBLE,
    MEMORY,
    MISMATCH,
    SECONDS,
    SINGLE,
    DiffersError,
    LineTerm,
    Model,
    NotProvedError,
    StartTerms,
    Term,
    TextTerm,
    as_bits,
    as_term,
    both,
    either,
    integer,
    number_at,
    opposite,
)
from rosmop.runtime.action_context import BUDGET
from rosmop.runtime.times import MAX_TIME
from rosmop.runtime.values import ValueCodec, struct_code
from rosmop.types import value_types
from rosmop.types.value_types import Type, Value

# Turn a model of z3 into a state that can be run.
#
# A model has the address and the length of a string, and for two strings whether they are equal; the bytes are chosen
# accordingly.

_ADDRESSES = 0xFFFFFFFF


def state_of(model: Model, begin: StartTerms, kinds: Mapping[str, Type], context: str) -> EventState:
    """Return the state of a model, for an event of a specification."""
    reader = _ModelReader(model, begin)
    size = reader.whole(begin.size, value_types.UINT)
    host, caller = (
        reader.text(begin.senders[context, part]) if (context, part) in begin.senders else b""
        for part in ("host", "caller")
    )
    return EventState(
        reader.bytes_of(begin.message, integer(0, 32), size),
        reader.whole(begin.now),
        {
            name: reader.value(begin.variables[name], kind) if name in begin.variables else []
            for name, kind in kinds.items()
        },
        reader.whole(begin.budgets[context]),
        {key: reader.whole(term) for key, term in begin.throttles.items()},
        (host, caller),
        bool(reader.number(begin.altered, value_types.UINT)),
    )


class _ModelReader:
    def __init__(self, model: Model, begin: StartTerms) -> None:
        self._model = model
        self._texts = [(integer(at, 32), raw) for raw, at in begin.constants.items()]

    def number(self, term: Term, kind: Type = value_types.LONG) -> float:
        value = self._model.eval(term, model_completion=True)
        if z3.is_bool(value):
            return z3.is_true(value)
        if z3.is_fp(value):
            bits = z3.simplify(z3.fpToIEEEBV(value))
            code, size = ("<d", 8) if value.sort() == DOUBLE else ("<f", 4)
            is_nan = not z3.is_bv_value(bits)
            return math.nan if is_nan else struct.unpack(code, bits.as_long().to_bytes(size, "little"))[0]
        is_signed = not isinstance(kind, value_types.IntegerType) or kind.signed
        return value.as_signed_long() if is_signed else value.as_long()

    def whole(self, term: Term, kind: Type = value_types.LONG) -> int:
        return int(self.number(term, kind))

    def bytes_of(self, array: Term, begin: Term, size: int) -> bytes:
        """Return bytes of an array from an address on."""
        array, at = (self._model.eval(term, model_completion=True) for term in (array, begin))
        places = [at.as_long() + more & _ADDRESSES for more in range(size)]
        written: dict[int, int] = {}
        while z3.is_store(array):
            array, place, value = array.children()
            written.setdefault(place.as_long(), value.as_long())
        if z3.is_const_array(array):
            rest = array.arg(0).as_long()
            return bytes(written.get(place, rest) for place in places)
        return bytes(
            written.get(place, z3.simplify(z3.Select(array, integer(place, 32))).as_long())
            for place in places
        )

    def value(self, term: Term | TextTerm, kind: Type) -> Value:
        if not isinstance(term, TextTerm):
            return self.number(term, kind)
        if isinstance(kind, value_types.StringType):
            return self.text(term)
        count = self.whole(term.count)
        if count > most_kept(kind):
            return [0] * (most_kept(kind) + 1)
        assert isinstance(kind, value_types.VectorType)  # noqa: S101  only these two are kept
        raw = self.bytes_of(MEMORY, term.place, count * kept_size(kind))
        return [*struct.unpack(f"<{count}{struct_code(kind.element)}", raw)]

    def text(self, term: TextTerm) -> bytes:
        """Return an earlier string of the same length if the model has no difference between the two."""
        place, count = term.place, self.whole(term.count)
        if count > most_kept(value_types.STRING):
            return bytes(most_kept(value_types.STRING) + 1)
        length = integer(count, 32)
        for other, raw in self._texts:
            pairs = (MISMATCH(place, other, length), MISMATCH(other, place, length))
            if len(raw) == count and count in (self.number(pair, value_types.UINT) for pair in pairs):
                return raw
        raw = bytes((ord("a") + len(self._texts) % 26,)) * count
        self._texts.append((place, raw))
        return raw


EQUAL = "equal"
IN_PYTHON = "not compiled: Python evaluates the messages of this topic"
LEFT = f"the module leaves each of {STATES} messages to Python"
PATIENCE = 30.0
"""Seconds of a processor for an event, which z3 counts as an effort: see `rosmop.prove.questions.Effort`."""

_UNROLLED = (1, 2, 3)

_FIRST_STATES = 100

_NOW, _REST, _ALTERED = 16, 32, 40  # addresses: see `rosmop.fast.abi`
_LATEST = 1 << 62


@dataclass(frozen=True)
class ProofFinding:
    """The result for an event on a topic, or part of a service.

    `answer` is `EQUAL`, the reason why equality is not known, or the difference. If it `differs`,
    `rosmop/fast` has a defect.
    """

    topic: str
    event: str
    answer: str
    differs: bool = False


def findings_of(compiled: Compiled, patience: float = PATIENCE) -> Iterator[ProofFinding]:
    found = list(groups(compiled.specifications))
    module = write(compiled.functions, [group.component for group in found], ValueCodec(compiled.messages))
    validation = Validation(compiled, module, patience)
    for group in found:
        for (topic, _), numbers in zip(group.component.topics, group.events, strict=True):
            for place, (number, index) in enumerate(numbers):
                specification = compiled.specifications[number]
                event = specification.events[index]
                yield validation.finding(topic, f"{specification.name}.{event.name}", event, place)
    in_module = {numbers for group in found for events in group.events for numbers in events}
    for number, specification in enumerate(compiled.specifications):
        for index, event in enumerate(specification.events):
            if event.channel is not None and (number, index) not in in_module:
                yield ProofFinding(event.channel, f"{specification.name}.{event.name}", IN_PYTHON)


class Validation:
    """Compares the module of a set with the form. Raises `UnknownInstructionError`, and `WasmError` for an invalid
    module.
    """

    def __init__(self, compiled: Compiled, module: WasmModule, patience: float = PATIENCE) -> None:
        self._compiled = compiled
        self._forms = compiled.functions
        self._values = ValueCodec(compiled.messages)
        self._module = module
        self._patience = patience
        self._codes = functions_of(module.code)
        self._runs = ConcreteRuns(compiled, module)
        self._kinds = {name: kind for own in module.cells for name, (_, kind) in own.variables.items()}
        kept = {at: kind for own in module.cells for at, kind in own.variables.values() if is_kept(kind)}
        self._strings = [range(at, at + len(raw)) for raw, at in module.strings.items()]
        self._strings += [
            range(begin, begin + 2 * room_of(kept[at]))
            for own in module.cells
            for at, begin in own.texts.items()
        ]
        self._strings += module.references
        self._strings += [range(at + 16, at + SENDER) for at in module.senders.values()]
        known = {"mismatch": MISMATCH, "seconds": SECONDS}
        self._routines = {number: known[name] for name, number in module.routines.items()}

    def finding(self, topic: str, name: str, event: EventCode, place: int) -> ProofFinding:
        """Return the result for an event, the function with this place among those of its topic."""
        if topic not in self._module.feeds:
            return ProofFinding(topic, name, IN_PYTHON)
        try:
            return ProofFinding(topic, name, self._compare(self._pair(topic, event, place)))
        except DiffersError as error:
            return ProofFinding(topic, name, f"not equal: {error}", differs=True)
        except NotProvedError as error:
            return ProofFinding(topic, name, str(error))

    def difference(self, topic: str, event: EventCode, place: int, most: int = STATES) -> str | None:
        """Return a difference in the effect that one of `most` random runs shows; z3 is not asked."""
        pair, before = self._pair(topic, event, place), self._runs.compared
        found = (self._runs.difference(pair, state) for state in islice(self._states(pair), most))
        what = next((one for one in found if one not in (None, BUDGET_ONLY)), None)
        return LEFT if self._runs.compared == before else what

    def _pair(self, topic: str, event: EventCode, place: int) -> EventPair:
        kind = value_types.RecordType(event.type or "")
        return EventPair(event.function, self._module.feeds[topic].functions[place], topic, kind)

    def _states(self, event: EventPair) -> Iterator[EventState]:
        return RandomStates(self._compiled, self._module, event).following(self._runs, event)

    def _search(self, event: EventPair, states: Iterable[EventState]) -> None:
        """Raise `DiffersError` for the first difference; for one of the budget only if there is no other."""
        of_budget: EventState | None = None
        for state in states:
            what = self._runs.difference(event, state)
            if what == BUDGET_ONLY:
                of_budget = of_budget or state
            elif what is not None:
                raise DiffersError(f"{what}, for {state}")
        if of_budget is not None:
            raise DiffersError(f"{BUDGET_ONLY}, for {of_budget}")

    def _compare(self, event: EventPair) -> str:
        states, before = self._states(event), self._runs.compared
        self._search(event, islice(states, _FIRST_STATES))
        answer = self._decide(event, states)
        if answer == EQUAL and self._runs.compared == before:
            self._search(event, states)
            return EQUAL if self._runs.compared > before else LEFT
        return answer

    def _decide(self, event: EventPair, states: Iterable[EventState]) -> str:
        effort = Effort(self._patience)
        try:
            return self._answer(event, effort, states)
        except MayDifferError as error:
            for most in _UNROLLED:
                self._answer(event, effort, states, most)
            raise NotProvedError(f"its loops are not known to be equal: {error}") from None

    def _answer(
        self, event: EventPair, effort: Effort, states: Iterable[EventState], unrolled: int = 0
    ) -> str:
        """`states` are those that are run if z3's first question leaves open whether there is a difference."""
        begin, cells, known = self._beginning()
        module, context = self._module, self._forms[event.name].context
        meant = FormTerms(
            self._forms,
            self._values,
            begin,
            event.name,
            topic=event.topic,
            lines=module.lines,
            unrolled=unrolled,
        ).result()
        form_cuts = meant.loops.cuts
        guess = LoopGuess(form_cuts, self._names(context), module.names, unrolled)
        execution = ModuleExecution(
            self._codes, event.number, begin.message, begin.size, cells, self._strings, self._routines,
            self._spans(begin), guess,
        )  # fmt: skip
        try:
            done = execution.run()
        except DiffersError:
            if meant.unknown and any(map(is_texts, self._kinds.values())):  # `cells` lacks these
                raise NotProvedError(f"uses {next(iter(meant.unknown))}") from None
            raise
        self._check_undone(done, event.topic)
        known += assumption(form_cuts)
        going_on = either(meant.loops.again, done.loops.again)
        left = either(done.trapped, both(_bit(done.bits, ELSEWHERE), opposite(done.loops.again)))
        unknown = either(*meant.unknown.values())
        if unrolled:
            known.append(opposite(going_on))
        wrong = {
            READS_BEYOND: done.outside,
            "it continues where the specification faults": both(opposite(left), meant.left),
        }
        others = {
            "whether it happened": _bit(done.bits, HAPPENED) != meant.happened,
            "whether the message is dropped": _bit(done.bits, DROPPED) != meant.dropped,
            "whether the safe message takes its place": _bit(done.bits, REPLACED) != meant.replaced,
            "whether the message is changed": _bit(done.bits, CHANGED) != meant.changed,
            "the message": done.message != meant.message,
            "no other bits": done.bits & ~(HAPPENED | DROPPED | CHANGED | REPLACED) != 0,
            **{
                f"the variable at {place}": opposite(_same(done.cells[place], value))
                for place, value in self._ends(meant)
            },
            "the size of the output": done.said != meant.said,
            **{
                f"the output ({place})": both(noted.alive, opposite(_among(noted, done.lines)))
                for place, noted in enumerate(meant.noted)
            },
        }
        reached = both(opposite(left), opposite(meant.left), opposite(going_on))
        decided = both(reached, opposite(unknown))
        wrong |= {text: both(decided, condition) for text, condition in others.items()}
        wrong |= loop_conditions(form_cuts, done.loops.cuts, either(meant.left, unknown), left)
        questions = Questions(effort, known)
        if not questions.exclude(wrong.values()):
            self._search(event, states)

            def replay(model: Model) -> None:
                self._search(event, [state_of(model, begin, self._kinds, context)])

            answer = first_difference(questions, wrong, replay, in_induction=bool(form_cuts))
            if answer is not None:
                return answer
        for what, condition in meant.unknown.items():
            if questions.decide(both(reached, condition))[0] != z3.unsat:
                return f"uses {what}"
        return EQUAL

    def _names(self, context: str) -> Mapping[int, object]:
        names: dict[int, object] = {
            address: ("shared", name)
            for own in self._module.cells
            for name, (address, _) in own.variables.items()
        }
        return names | {self._module.budgets[context]: BUDGET_SLOT}

    def _spans(self, begin: StartTerms) -> Sequence[ReadableBytes]:
        spans = [
            ReadableBytes(integer(at, 32), integer(len(raw), 64), z3.BoolVal(True))
            for raw, at in self._module.strings.items()
        ]
        for own in self._module.cells:
            for name, (_, kind) in own.variables.items():
                if kept_size(kind) and not isinstance(kind, value_types.StringType):
                    kept = begin.variables[name]
                    assert isinstance(kept, TextTerm)  # noqa: S101  as in `_beginning`
                    known = z3.ULE(kept.count, most_kept(kind))
                    spans.append(ReadableBytes(kept.place, kept.count * kept_size(kind), known))
        return spans

    def _beginning(self) -> tuple[StartTerms, dict[int, Term], list[Term]]:
        now, size = z3.BitVec("now", 64), z3.BitVec("size", 32)
        known: list[Term] = [now >= 0, now < _LATEST, z3.ULE(size, AREA)]
        cells: dict[int, Term] = {_NOW: now, _REST: integer(0, 64)}
        variables: dict[str, Term | TextTerm] = {}
        for component in self._module.cells:
            for name, (address, kind) in component.variables.items():
                if is_texts(kind):  # an event that uses it is not proved
                    continue
                if kept_size(kind):
                    variables[name] = _text(name, address, cells)
                    continue
                value = variables[name] = cells[address] = _variable(name, kind)
                if isinstance(kind, value_types.TimeType | value_types.DurationType):
                    most = MAX_TIME + (1 << 32)
                    known += [value >= -most, value <= most]
        budgets = {context: z3.BitVec(f"budget of {context}", 64) for context in self._module.budgets}
        for context, address in self._module.budgets.items():
            known += [budgets[context] >= 0, budgets[context] <= BUDGET]
            cells[address] = budgets[context]
        throttles = {key: z3.BitVec(f"output of {key}", 64) for key in self._module.throttles}
        for key, address in self._module.throttles.items():
            known.append(throttles[key] >= 0)
            cells[address] = throttles[key]
        senders = {
            (context, part): _text(f"{part} of {context}", at + 8 * place, cells)
            for context, at in self._module.senders.items()
            for place, part in enumerate(("host", "caller"))
        }
        message = z3.Array("message", z3.BitVecSort(32), z3.BitVecSort(8))
        constants = self._module.strings
        altered = cells[_ALTERED] = z3.BitVec("altered", 32)
        begin = StartTerms(message, size, now, variables, budgets, throttles, senders, constants, altered)
        return begin, cells, known

    def _ends(self, meant: FormResult) -> Iterator[tuple[int, Term]]:
        for component in self._module.cells:
            for name, (address, _) in component.variables.items():
                value = meant.variables.get(name)
                if isinstance(value, TextTerm):
                    yield address, value.place
                    yield address + 4, z3.Extract(31, 0, value.count)
                elif value is not None:
                    yield address, as_term(value)
        for context, address in self._module.budgets.items():
            yield address, meant.budgets[context]

    def _check_undone(self, done: ModuleResult, topic: str) -> None:
        undone = [address for address, _ in self._module.feeds[topic].undo]
        taken_back = {*undone, *(address + 4 for address in undone)}  # eight bytes each
        for address in sorted(done.stored - set(self._module.budgets.values()) - taken_back):
            raise DiffersError(f"its write at {address} is not undone")


def _text(name: str, address: int, cells: dict[int, Term]) -> TextTerm:
    place, length = (z3.BitVec(f"{part} of {name}", 32) for part in ("address", "length"))
    cells |= {address: place, address + 4: length}
    return TextTerm(place, z3.ZeroExt(32, length))


def _same(held: object, value: Term) -> Term:
    if isinstance(held, Pointer):
        raise NotProvedError("keeps a string of the message")
    return as_term(held) == (as_bits(value) if z3.is_bool(value) and not z3.is_bool(held) else value)


def _among(noted: LineTerm, lines: Term) -> Term:
    return either(*(number_at(lines, noted.offset, one.size() // 8) == one for one in noted.allowed))


def _bit(bits: Term, which: int) -> Term:
    return bits & which != 0


def _variable(name: str, kind: Type) -> Term:
    if isinstance(kind, value_types.BoolType):
        return z3.Bool(name)
    if isinstance(kind, value_types.FloatingType):
        return z3.FP(name, DOUBLE if kind.bits == 64 else SINGLE)
    if isinstance(kind, value_types.IntegerType) and kind.bits <= 32:
        return wrap(z3.BitVec(name, 32), kind)
    return z3.BitVec(name, 64)
