"""Turn a model of z3 into a state that can be run.

A model has the address and the length of a string, and for two strings whether they are equal; the bytes are chosen
accordingly.
"""

import math
import struct
from collections.abc import Mapping

import z3

from rosmop.fast.abi import kept_size, most_kept
from rosmop.prove.concrete_runs import EventState
from rosmop.prove.terms import DOUBLE, MEMORY, MISMATCH, Model, StartTerms, Term, TextTerm, integer
from rosmop.runtime.values import struct_code
from rosmop.types import value_types
from rosmop.types.value_types import Type, Value

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
        {name: reader.value(term, kinds[name]) for name, term in begin.variables.items()},
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
