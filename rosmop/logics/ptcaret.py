"""``ptcaret``: past-time linear temporal logic with calls and returns, as MOP's PTCaRet plugin reads it.

The *abstract* past has every call that has returned as one opaque step. All operators about stacks (``@b``,
``<*s@c>``) are derived from its operators (Rosu, Chen and Ball, 2008); ``docs/reference/logics.md`` has the
definitions.
"""

from itertools import zip_longest
from typing import Any

from rosmop.logics.formula import Formula, Level, Syntax, boolean_levels, nodes, read_formula
from rosmop.logics.interface import Categories, CompiledProperty, Run, RunFaultError, Source, UntimedRun
from rosmop.logics.past_monitors import TOLD, VERDICTS, FoldedProgram, PastProgram, fold
from rosmop.logics.ptltl import SYNTAX as PTLTL

MAX_DEPTH = 10_000

BEGIN, END, CALL = "begin", "end", "call"

SYNTAX = Syntax(
    unary={
        **PTLTL.unary,
        "(*a)": "abstract previously",
        "<*a>": "abstract once",
        "[*a]": "abstract historically",
        "@b": "at begin",
        "@c": "at call",
        **{f"<*s@{where}>": f"some {where}" for where in ("b", "c", "bc")},
        **{f"[*s@{where}]": f"every {where}" for where in ("b", "c", "bc")},
    },
    levels=boolean_levels(
        [
            Level({"S": "since", "~S": "dual since"}, "left"),
            Level({"Sa": "abstract since"}, "left"),
            *(Level({f"Ss@{where}": f"stack-since {where}"}, "left") for where in ("bc", "c", "b")),
        ]
    ),
    refused={**PTLTL.refused, "Ss": "has no meaning here; write `Ss@b`, `Ss@c` or `Ss@bc`, without a space"},
)


def compile_ptcaret(source: Source) -> CompiledProperty:
    formula = plain(read_formula(source, SYNTAX))
    missing = [name for name in (BEGIN, END) if name not in source.events]
    if missing and any(node.operator.startswith("abstract ") for node in nodes(formula)):
        names = " and ".join(f"`{name}`" for name in missing)
        raise source.error(
            0, f"the abstract past needs the events `begin` and `end` of the specification; it has no {names}"
        )
    if CALL not in source.events and any(node.name == CALL for node in nodes(formula)):
        raise source.error(0, "this formula needs the event `call` of the specification")
    program = PastProgram(formula, source.events)
    return CaretProperty(source, fold(program, [program.result]))


class CaretProperty(CompiledProperty):
    """A property whose stack has the state of the abstract operators for each open call."""

    def __init__(self, source: Source, folded: FoldedProgram) -> None:
        super().__init__(source, VERDICTS)
        self.folded = folded
        places = [source.events.index(name) if name in source.events else -1 for name in (BEGIN, END)]
        self.begin, self.end = places

    def start(self, _time_ns: int) -> Run:
        return CaretRun(self)


class CaretRun(UntimedRun):
    """A run: its values, and for each open call the values about the abstract past from before it."""

    __slots__ = ("_compiled", "_stack", "_values")

    def __init__(self, compiled: CaretProperty) -> None:
        self._compiled = compiled
        self._values = compiled.folded.start()
        self._stack: list[tuple[bool, ...]] = []

    def __copy__(self) -> "CaretRun":
        made = CaretRun(self._compiled)
        made._values, made._stack = self._values.copy(), self._stack.copy()
        return made

    def step(self, event: int, _time_ns: int) -> Categories:
        compiled, values, stack = self._compiled, self._values, self._stack
        abstract = compiled.folded.abstract
        if event == compiled.begin:
            if len(stack) >= MAX_DEPTH:
                raise RunFaultError(f"more than {MAX_DEPTH} calls are open: an `end` is missing")
            stack.append(tuple(values[place] for place in abstract))
        (result,) = compiled.folded.take(values, event, 0)
        holds = values[result]
        if event == compiled.end:
            for place, before in zip_longest(abstract, stack.pop() if stack else (), fillvalue=False):
                values[place] = before
        return TOLD[holds]

    def save(self) -> tuple[Any, ...]:
        return self._stack, self._values

    def restore(self, saved: tuple[Any, ...]) -> None:
        self._stack, self._values = saved


def plain(formula: Formula) -> Formula:
    operands = tuple(plain(operand) for operand in formula.operands)
    operator, _, where = formula.operator.partition(" ")
    if operator == "stack-since":
        return _stack_since(where, *operands)
    if operator not in ("at", "some", "every"):
        return Formula(formula.operator, operands, formula.name, formula.bounds, formula.offset)
    inner = operands[0]
    if where in ("c", "call"):
        inner = Formula("dual previously" if operator == "every" else "previously", (inner,))
    there = Formula("event", name=BEGIN)
    if where == "bc":
        there = Formula("or", (there, Formula("event", name=CALL)))
    if operator == "every":
        return Formula("abstract historically", (Formula("implies", (there, inner)),))
    both = Formula("and", (there, inner))
    if operator == "some":
        return Formula("abstract once", (both,))
    return Formula("abstract since", (Formula("not", (there,)), both))


def _stack_since(where: str, left: Formula, right: Formula) -> Formula:
    begin, call = Formula("event", name=BEGIN), Formula("event", name=CALL)
    both = Formula("or", (begin, call))
    guard = {"b": begin, "c": call, "bc": both}[where]
    place = both if where == "bc" else begin
    there = Formula("previously", (right,)) if where == "c" else right
    return Formula("abstract since", (Formula("implies", (guard, left)), Formula("and", (place, there))))
