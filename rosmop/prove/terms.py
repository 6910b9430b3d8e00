"""Terms of z3 for both sides, their initial state, and states that merge branches.

A message is an array of bytes with addresses of 32 bits. Bit vectors have 64 or 32 bits; narrower numbers are
extended by their sign or by zeros. There is only one NaN, and its bits cannot be read.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TypeVar, overload

import z3

Term = z3.ExprRef
Sort = z3.SortRef
Model = z3.ModelRef
_T = TypeVar("_T")

DOUBLE, SINGLE = z3.Float64(), z3.Float32()
NEAREST = z3.RNE()
AT = z3.BitVec("at", 32)
FRAME = z3.BitVec("position", 32)
MEMORY = z3.Array("memory", z3.BitVecSort(32), z3.BitVecSort(8))

MISMATCH = z3.Function("mismatch", *[z3.BitVecSort(32)] * 4)
"""The index of the first difference of two strings (addresses and length), or the length. It is not translated."""
SECONDS = z3.Function("seconds", z3.BitVecSort(64), DOUBLE)


@dataclass(frozen=True)
class TextTerm:
    """A string or array outside the message: address (32 bits) and number of elements (64 bits)."""

    place: Term
    count: Term


class NotProvedError(Exception):
    """An event about which nothing is known; the message gives the reason."""


class Mixed:
    """Marks a slot that has different kinds of values in two branches, and must not be read."""


MIXED = Mixed()


class DiffersError(Exception):
    """A difference between the module and the form."""


def integer(value: int, bits: int) -> Term:
    return z3.BitVecVal(value, bits)


def floating(value: float, bits: int) -> Term:
    number = int.from_bytes(struct.pack("<d" if bits == 64 else "<f", value), "little")
    return z3.simplify(z3.fpBVToFP(integer(number, bits), DOUBLE if bits == 64 else SINGLE))


def both(*conditions: Term) -> Term:
    rest = [condition for condition in conditions if not z3.is_true(condition)]
    if any(z3.is_false(condition) for condition in rest):
        return z3.BoolVal(False)
    return z3.BoolVal(True) if not rest else rest[0] if len(rest) == 1 else z3.And(*rest)


def either(*conditions: Term) -> Term:
    rest = [condition for condition in conditions if not z3.is_false(condition)]
    if any(z3.is_true(condition) for condition in rest):
        return z3.BoolVal(True)
    return z3.BoolVal(False) if not rest else rest[0] if len(rest) == 1 else z3.Or(*rest)


def opposite(condition: Term) -> Term:
    if z3.is_not(condition):
        return condition.arg(0)
    known = z3.is_true(condition) or z3.is_false(condition)
    return z3.BoolVal(z3.is_false(condition)) if known else z3.Not(condition)


def as_term(value: object) -> Term:
    if not isinstance(value, Term):
        raise NotProvedError("uses a variable for an address and a number")
    return value


@overload
def choice(test: Term, yes: Term, no: Term) -> Term: ...


@overload
def choice(test: Term, yes: _T | None, no: _T | None) -> _T | Mixed: ...


def choice(test: Term, yes: object, no: object) -> object:
    """`test ? yes : no` for terms or structures of terms. A part that only one of them has is used as it is."""
    if z3.is_true(test) or no is None or yes is no:
        return yes
    if z3.is_false(test) or yes is None:
        return no
    if isinstance(yes, tuple) and isinstance(no, tuple) and len(yes) == len(no):
        return tuple(choice(test, *parts) for parts in zip(yes, no, strict=True))
    if is_dataclass(yes) and not isinstance(yes, type) and type(yes) is type(no):
        parts = {
            field.name: choice(test, getattr(yes, field.name), getattr(no, field.name))
            for field in fields(yes)
        }
        return replace(yes, **parts)
    if isinstance(yes, Term) and isinstance(no, Term):
        if z3.is_bool(yes) != z3.is_bool(no):
            yes, no = (as_bits(truth) if z3.is_bool(truth) else truth for truth in (yes, no))
        if yes.sort() == no.sort():
            return yes if yes.eq(no) else z3.If(test, yes, no)
    elif isinstance(yes, int | str) and yes == no:
        return yes
    return MIXED


def as_bits(truth: Term, bits: int = 32) -> Term:
    return z3.If(truth, integer(1, bits), integer(0, bits))


def number_at(message: Term, position: Term, size: int) -> Term:
    every = [z3.Select(message, position + integer(more, 32) if more else position) for more in range(size)]
    return every[0] if size == 1 else z3.Concat(*reversed(every))


def with_number(message: Term, position: Term, value: Term) -> Term:
    for more in range(value.size() // 8):
        place = position + integer(more, 32) if more else position
        message = z3.Store(message, place, z3.Extract(8 * more + 7, 8 * more, value))
    return message


def with_sign(value: Term, sign: Term) -> Term:
    """Return `copysign` of two terms, for a `sign` other than NaN."""
    return z3.If(z3.fpIsNegative(sign), z3.fpNeg(z3.fpAbs(value)), z3.fpAbs(value))


@dataclass
class State:
    """A point of a function: the condition under which it is reached (`alive`), and values."""

    alive: Term
    slots: dict[object, object]

    def term(self, slot: object) -> Term:
        """Return the value of a slot that has a term."""
        return as_term(self.slots[slot])

    def where(self, condition: Term) -> "State":
        return State(both(self.alive, condition), dict(self.slots))

    def require(self, condition: Term) -> None:
        self.alive = both(self.alive, condition)

    def join(self, test: Term, yes: "State", no: "State") -> None:
        whole = yes.alive.eq(both(self.alive, test)) and no.alive.eq(both(self.alive, opposite(test)))
        self.alive = self.alive if whole else either(yes.alive, no.alive)
        self.slots = merge(test, yes, no)


def merge(test: Term, yes: State, no: State) -> dict[object, object]:
    if z3.is_false(no.alive):
        return yes.slots
    if z3.is_false(yes.alive):
        return no.slots
    return {key: choice(test, yes.slots.get(key), no.slots.get(key)) for key in {**yes.slots, **no.slots}}


@dataclass(frozen=True)
class StartTerms:
    """The initial state of an event.

    Budgets are by context, throttles (times of output) by context and site, senders by context and part.
    `constants` are the addresses of constant strings.
    """

    message: Term
    size: Term
    now: Term
    variables: Mapping[str, Term | TextTerm]
    budgets: Mapping[str, Term]
    throttles: Mapping[tuple[str, int], Term]
    senders: Mapping[tuple[str, str], TextTerm]
    constants: Mapping[bytes, int]
    altered: Term


@dataclass(frozen=True)
class LineTerm:
    """A part of a line of output: under the condition `alive`, it is one of the allowed values."""

    alive: Term
    offset: Term
    allowed: Sequence[Term]


_SMALL = 1 << 10
_COSTLY = frozenset((
    z3.Z3_OP_FPA_ADD, z3.Z3_OP_FPA_SUB, z3.Z3_OP_FPA_MUL, z3.Z3_OP_FPA_DIV, z3.Z3_OP_FPA_SQRT,
    z3.Z3_OP_FPA_ROUND_TO_INTEGRAL, z3.Z3_OP_FPA_TO_FP, z3.Z3_OP_FPA_TO_FP_UNSIGNED, z3.Z3_OP_FPA_TO_UBV,
    z3.Z3_OP_FPA_TO_SBV, z3.Z3_OP_FPA_TO_IEEE_BV, z3.Z3_OP_BMUL, z3.Z3_OP_BSDIV, z3.Z3_OP_BUDIV, z3.Z3_OP_BSREM,
    z3.Z3_OP_BUREM, z3.Z3_OP_BSDIV_I, z3.Z3_OP_BUDIV_I, z3.Z3_OP_BSREM_I, z3.Z3_OP_BUREM_I,
))  # fmt: skip
_COMMUTATIVE = frozenset((z3.Z3_OP_FPA_ADD, z3.Z3_OP_FPA_MUL))
_FLOATING = frozenset((z3.Z3_FLOATING_POINT_SORT, z3.Z3_ROUNDING_MODE_SORT))


class Abstraction:
    """Replaces the results of costly operations by variables, the same variable for equal operands.

    With `floats`, floating-point numbers are values that are only equal or not. If a formula over these
    variables cannot hold, the original formula cannot hold.
    """

    def __init__(self, *, floats: bool = False) -> None:
        self._floats = floats
        self._known: dict[int, tuple[Term, Term]] = {}
        """Each term with its replacement, by its number. Keeping the term keeps z3 from reusing its number."""
        self._laws: list[Term] = []
        """Sums and products commute here, because the simplifier orders their operands in no fixed way."""

    def of(self, terms: Sequence[Term]) -> list[Term]:
        begin = [z3.simplify(term) for term in terms]
        known, waiting = self._known, list(begin)
        while waiting:
            term = waiting[-1]
            parts = term.children()
            missing = [part for part in parts if part.get_id() not in known]
            if missing:
                waiting += missing
                continue
            waiting.pop()
            if term.get_id() not in known:
                new = [known[part.get_id()][1] for part in parts]
                abstract = _abstract(term, new, floats=self._floats)
                known[term.get_id()] = term, abstract
                if term.decl().kind() in _COMMUTATIVE and abstract.decl().kind() == z3.Z3_OP_UNINTERPRETED:
                    *mode, one, other = new
                    self._laws.append(abstract == abstract.decl()(*mode, other, one))
        return [*(known[term.get_id()][1] for term in begin), *self._laws]


def _abstract(term: Term, operands: Sequence[Term], *, floats: bool) -> Term:
    kind, parts = term.decl().kind(), term.children()
    sorts = [part.sort() for part in (*parts, term)]
    if floats and any(sort.kind() in _FLOATING for sort in sorts):
        if kind == z3.Z3_OP_ITE:
            return z3.If(*operands)
        if kind == z3.Z3_OP_EQ:
            return operands[0] == operands[1]
        sorts = [z3.DeclareSort(str(sort)) if sort.kind() in _FLOATING else sort for sort in sorts]
    elif kind not in _COSTLY or _is_cheap(kind, operands):
        changed = any(not operand.eq(part) for operand, part in zip(operands, parts, strict=True))
        return term.decl()(*operands) if changed else term
    name = " ".join(map(str, (term.decl() if parts else term.sexpr(), *sorts)))  # exact for each number
    return z3.Function(name, *sorts)(*operands)


def _is_cheap(kind: int, operands: Sequence[Term]) -> bool:
    small = any(z3.is_bv_value(operand) and abs(operand.as_signed_long()) < _SMALL for operand in operands)
    return (kind == z3.Z3_OP_BMUL and small) or all(map(_is_number, operands))


def _is_number(term: Term) -> bool:
    return bool(z3.is_bv_value(term) or z3.is_fp_value(term) or z3.is_fprm_value(term))
