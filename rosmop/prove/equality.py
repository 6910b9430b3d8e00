"""Ask z3 whether the compiled code of an event can differ from its intermediate form (`form/nodes.py`).

Both are compared for every message of up to `AREA` bytes and every state. They are equal if the function
leaves the message to Python, which then processes it from the start, or if all of these hold:

- the form does not fault;
- both agree on whether the event happened, and dropped, replaced or changed the message;
- the message, the variables, the rest of the budget and the lines of output are the same.

Whether two strings in variables or names of senders are equal is left open, and an event that reads their
bytes is not proved. If the function leaves the message, each variable that it wrote must be restored, and
each byte must be in the log (`module_terms.py`).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import z3

from rosmop.fast.abi import AREA, SENDER, kept_size, most_kept
from rosmop.fast.batch_codegen import WasmModule, written
from rosmop.form import nodes
from rosmop.form.compiled import Compiled
from rosmop.form.specification_groups import groups
from rosmop.prove.decoding import functions_of
from rosmop.prove.form_terms import FormTerms, wrapped
from rosmop.prove.loops import BUDGET_SLOT, assumed, loop_conditions
from rosmop.prove.module_terms import LoopGuess, ModuleExecution, ModuleResult, Pointer, ReadableBytes
from rosmop.prove.terms import (
    DOUBLE,
    MISMATCH,
    SECONDS,
    SINGLE,
    Abstraction,
    DiffersError,
    FormResult,
    LineTerm,
    NotProvedError,
    StartTerms,
    Term,
    TextTerm,
    as_bits,
    both,
    either,
    integer,
    number_at,
    opposite,
)
from rosmop.runtime.action_context import BUDGET
from rosmop.runtime.times import MAX_TIME
from rosmop.runtime.values import ValueCodec
from rosmop.types import value_types
from rosmop.types.value_types import Type

EQUAL = "equal"
IN_PYTHON = "not compiled: Python evaluates the messages of this topic"
PATIENCE = 30.0

_TOGETHER = 0.2

_UNROLLED = (1, 2, 3)

_NOW, _REST = 16, 32  # addresses of the time and of the number of bytes that are not shown
_HAPPENED, _DROPPED, _CHANGED, _ELSEWHERE, _REPLACED = 1, 2, 4, 8, 32
_LATEST = 1 << 62


class _MayDifferError(Exception):
    """The induction over the iterations of a loop fails for a state that may not occur."""


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


def findings_of(
    compiled: Compiled, clock: Callable[[], float], patience: float = PATIENCE
) -> Iterator[ProofFinding]:
    found = list(groups(compiled.specifications))
    values = ValueCodec(compiled.messages)
    module = written(compiled.functions, [group.component for group in found], values)
    validation = Validation(compiled.functions, values, module, clock, patience)
    for group in found:
        for (topic, events), numbers in zip(group.component.topics, group.events, strict=True):
            for place, (code, (number, index)) in enumerate(zip(events, numbers, strict=True)):
                specification = compiled.specifications[number]
                name = f"{specification.name}.{specification.events[index].name}"
                yield validation.finding(topic, name, code.function, place)
    in_module = {numbers for group in found for events in group.events for numbers in events}
    for number, specification in enumerate(compiled.specifications):
        for index, event in enumerate(specification.events):
            if event.channel is not None and (number, index) not in in_module:
                yield ProofFinding(event.channel, f"{specification.name}.{event.name}", IN_PYTHON)


class Validation:
    """Compares the module of a set with the form. Raises `UnknownInstructionError`."""

    def __init__(
        self,
        functions: Mapping[str, nodes.Function],
        values: ValueCodec,
        module: WasmModule,
        clock: Callable[[], float],
        patience: float = PATIENCE,
    ) -> None:
        self._forms = functions
        self._values = values
        self._module = module
        self._clock = clock
        self._patience = patience
        self.codes = functions_of(module.code)
        kept = {at: kind for own in module.cells for at, kind in own.variables.values() if kept_size(kind)}
        self._strings = [range(at, at + len(raw)) for raw, at in module.strings.items()]
        self._strings += [
            range(begin, begin + 2 * most_kept(kept[at]) * kept_size(kept[at]))
            for own in module.cells
            for at, begin in own.texts.items()
        ]
        self._strings += module.references
        self._strings += [range(at + 16, at + SENDER) for at in module.senders.values()]
        known = {"mismatch": MISMATCH, "seconds": SECONDS}
        self._routines = {number: known[name] for name, number in module.routines.items()}

    def finding(self, topic: str, event: str, function: str, place: int) -> ProofFinding:
        feed = self._module.feeds.get(topic)
        if feed is None:
            return ProofFinding(topic, event, IN_PYTHON)
        try:
            return ProofFinding(topic, event, self._compared(function, feed.functions[place], topic))
        except DiffersError as error:
            return ProofFinding(topic, event, f"not equal: {error}", differs=True)
        except NotProvedError as error:
            return ProofFinding(topic, event, str(error))

    def _compared(self, name: str, number: int, topic: str) -> str:
        begun = self._clock()
        try:
            return self._answer(name, number, topic, begun)
        except _MayDifferError as error:
            for most in _UNROLLED:
                self._answer(name, number, topic, begun, most)
            raise NotProvedError(f"its loops are not known to be equal: {error}") from None

    def _answer(self, name: str, number: int, topic: str, begun: float, unrolled: int = 0) -> str:
        begin, cells, known = self._beginning()
        module = self._module
        meant = FormTerms(
            self._forms, self._values, begin, name, topic=topic, lines=module.lines, unrolled=unrolled
        ).result()
        form_cuts = meant.loops.cuts
        guess = LoopGuess(form_cuts, self._names(self._forms[name].context), module.names, unrolled)
        done = ModuleExecution(
            self.codes, number, begin.message, begin.size, cells, self._strings, self._routines,
            self._spans(begin), guess,
        ).done()  # fmt: skip
        self._check_undone(done, topic)
        known += assumed(form_cuts)
        going_on = either(meant.loops.again, done.loops.again)
        left = either(done.trapped, both(done.bits == _ELSEWHERE, opposite(done.loops.again)))
        unknown = either(*meant.unknown.values())
        if unrolled:
            known.append(opposite(going_on))
        wrong = {
            "it reads beyond the message": done.outside,
            "it continues where the specification faults": both(opposite(left), meant.left),
        }
        others = {
            "whether it happened": _bit(done.bits, _HAPPENED) != meant.happened,
            "whether the message is dropped": _bit(done.bits, _DROPPED) != meant.dropped,
            "whether the safe message takes its place": _bit(done.bits, _REPLACED) != meant.replaced,
            "whether the message is changed": _bit(done.bits, _CHANGED) != meant.changed,
            "the message": done.message != meant.message,
            "no other bits": done.bits & ~(_HAPPENED | _DROPPED | _CHANGED | _REPLACED) != 0,
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
        decided = both(opposite(left), opposite(meant.left), opposite(unknown), opposite(going_on))
        wrong |= {text: both(decided, condition) for text, condition in others.items()}
        wrong |= loop_conditions(form_cuts, done.loops.cuts, either(meant.left, unknown), left)
        answer = self._first(known, wrong, begun, found=_MayDifferError if form_cuts else DiffersError)
        if answer is not None:
            return answer
        for what, condition in meant.unknown.items():
            question = [*known, opposite(left), opposite(meant.left), opposite(going_on), condition]
            if self._decided(question, begun)[0] != z3.unsat:
                return f"uses {what}"
        return EQUAL

    def _names(self, context: str) -> Mapping[int, Any]:
        names: dict[int, Any] = {
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
                    known = z3.ULE(kept.count, most_kept(kind))
                    spans.append(ReadableBytes(kept.place, kept.count * kept_size(kind), known))
        return spans

    def _first(
        self, known: Sequence[Term], wrong: Mapping[str, Term], begun: float, *, found: type[Exception]
    ) -> str | None:
        possible = {
            text: simple for text, one in wrong.items() if not z3.is_false(simple := z3.simplify(one))
        }
        every = [*known, either(*possible.values())]
        if self._asked(Abstraction(floats=True).of(every), begun, part=_TOGETHER)[0] == z3.unsat:
            return None
        undecided = False
        for text, condition in possible.items():
            answer, model = self._decided([*known, condition], begun)
            if model is not None:
                raise found(f"{text}, for {_example(model)}")
            undecided = undecided or answer != z3.unsat
        return "not decided in time" if undecided else None

    def _decided(self, question: Sequence[Term], begun: float) -> tuple[Any, Any]:
        for abstraction in (Abstraction(floats=True), Abstraction()):
            answer, guess = self._asked(abstraction.of(question), begun)
            if answer == z3.unsat:
                return answer, None
        if guess is not None and _holds(question, guess):
            return answer, guess
        return self._asked(question, begun)

    def _asked(self, conditions: Sequence[Term], begun: float, *, part: float = 1) -> tuple[Any, Any]:
        rest = int(1000 * part * (begun + self._patience - self._clock()))
        if rest <= 0:
            return z3.unknown, None
        solver = z3.Solver()
        solver.set("timeout", rest)
        solver.add(*conditions)
        answer = solver.check()
        return answer, solver.model() if answer == z3.sat else None

    def _beginning(self) -> tuple[StartTerms, dict[int, Term], list[Term]]:
        now, size = z3.BitVec("now", 64), z3.BitVec("size", 32)
        known = [now >= 0, now < _LATEST, z3.ULE(size, AREA)]
        cells: dict[int, Term] = {_NOW: now, _REST: integer(0, 64)}
        variables: dict[str, Any] = {}
        for component in self._module.cells:
            for name, (address, kind) in component.variables.items():
                if kept_size(kind):
                    variables[name] = _text(name, address, cells)
                    continue
                variables[name] = cells[address] = _variable(name, kind)
                if isinstance(kind, value_types.TimeType | value_types.DurationType):
                    most = MAX_TIME + (1 << 32)
                    known += [variables[name] >= -most, variables[name] <= most]
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
        begin = StartTerms(message, size, now, variables, budgets, throttles, senders, constants)
        return begin, cells, known

    def _ends(self, meant: FormResult) -> Iterator[tuple[int, Term]]:
        for component in self._module.cells:
            for name, (address, _) in component.variables.items():
                value = meant.variables.get(name)
                if isinstance(value, TextTerm):
                    yield address, value.place
                    yield address + 4, z3.Extract(31, 0, value.count)
                elif value is not None:
                    yield address, value
        for context, address in self._module.budgets.items():
            yield address, meant.budgets[context]

    def _check_undone(self, done: ModuleResult, topic: str) -> None:
        undone = [address for address, _ in self._module.feeds[topic].undo]
        taken_back = {*undone, *(address + 4 for address in undone)}  # eight bytes each
        for address in sorted(done.stored - set(self._module.budgets.values()) - taken_back):
            raise DiffersError(f"its write at {address} is not undone")


def _holds(conditions: Sequence[Term], guess: Any) -> bool:
    values = [
        (declaration(), guess[declaration]) for declaration in guess.decls() if declaration.arity() == 0
    ]
    known = [
        (declaration, value)
        for declaration, value in values
        if value is not None and not isinstance(value, z3.FuncInterp)
    ]
    return all(z3.is_true(z3.simplify(z3.substitute(condition, *known))) for condition in conditions)


def _example(model: Any) -> str:
    return ", ".join(
        f"{declaration} = {model[declaration]}" for declaration in model.decls() if declaration.arity() == 0
    )


def _text(name: str, address: int, cells: dict[int, Term]) -> TextTerm:
    place, length = (z3.BitVec(f"{part} of {name}", 32) for part in ("address", "length"))
    cells |= {address: place, address + 4: length}
    return TextTerm(place, z3.ZeroExt(32, length))


def _same(held: Term, value: Term) -> Term:
    if isinstance(held, Pointer):
        raise NotProvedError("keeps a string of the message")
    return held == (as_bits(value) if z3.is_bool(value) and not z3.is_bool(held) else value)


def _among(noted: LineTerm, lines: Term) -> Term:
    held = number_at(lines, noted.offset, noted.allowed[0].size() // 8) if noted.allowed else None
    return either(*(held == one for one in noted.allowed))


def _bit(bits: Term, which: int) -> Term:
    return bits & which != 0


def _variable(name: str, kind: Type) -> Term:
    if isinstance(kind, value_types.BoolType):
        return z3.Bool(name)
    if isinstance(kind, value_types.FloatingType):
        return z3.FP(name, DOUBLE if kind.bits == 64 else SINGLE)
    if isinstance(kind, value_types.IntegerType) and kind.bits <= 32:
        return wrapped(z3.BitVec(name, 32), kind)
    return z3.BitVec(name, 64)
