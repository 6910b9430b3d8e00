"""Keep the slices of a running parametric specification as data, in `BUCKETS` parts by their bindings.

Only the parts with a changed slice are written, so a message costs a hundredth of all slices.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from rosmop.form.compiled import SpecificationCode
from rosmop.run.slices import Binding, Slice, Slices, of_nan
from rosmop.run.state_of_runs import StateTooLargeError, dump, run_of
from rosmop.types.value_types import Type, Value

BUCKETS = 128


class SliceSnapshot(msgspec.Struct, frozen=True, array_like=True):
    """A slice: `domain` has the parameters as bits, and `holder` is charged.

    `number` counts slices in the order in which they began or ended; an ended slice has no state.
    """

    number: int
    domain: int
    key: list[Any]
    holder: str | None
    ended: bool
    runs: list[object] = []
    values: list[Any] = []
    due: int | None = None
    turn: int = 0


class PartSnapshot(msgspec.Struct, frozen=True, tag="PartSnapshot"):
    """Some of the slices of a specification."""

    slices: list[SliceSnapshot]


class _Written(msgspec.Struct, frozen=True, tag="PartSnapshot"):
    slices: list[msgspec.Raw]


class SliceParts:
    """The parts of one specification, as last written."""

    def __init__(self, slices: Slices) -> None:
        self._slices = slices
        self._parts: list[dict[Binding, tuple[int, bool, msgspec.Raw]]] = [{} for _ in range(BUCKETS)]
        self._number = 0
        self._failed: list[dict[Binding, str]] = [{} for _ in range(BUCKETS)]
        slices.keep()

    def changed_parts(self) -> dict[int, bytes]:
        """Return the changed parts by number. A part with a slice that is too large to be saved is the reason."""
        bindings, dirty = self._slices.changed or {}, set()
        self._slices.changed = {}
        for binding, holder in bindings.items():
            number = hash(binding) % BUCKETS
            dirty.add(number)
            self._failed[number].pop(binding, None)
            try:
                self._take(self._parts[number], binding, None if holder is None else str(holder))
            except StateTooLargeError as error:
                self._failed[number][binding] = str(error)
        return {number: self._encode(number) for number in dirty}

    def all(self) -> list[bytes]:
        self.changed_parts()
        return [self._encode(number) for number in range(BUCKETS)]

    def _take(
        self, part: dict[Binding, tuple[int, bool, msgspec.Raw]], binding: Binding, holder: str | None
    ) -> None:
        try:
            slice_ = self._slices.state(binding)
        except KeyError:
            part.pop(binding, None)
            return
        ended = slice_ is None
        number, was_ended, _ = part.get(binding, (-1, False, None))
        if number < 0 or was_ended is not ended:
            number, self._number = self._number, self._number + 1
        domain, key = binding
        state: tuple[Any, ...] = ()
        if slice_ is not None:
            state = [*map(dump, slice_.runs)], [*slice_.values], slice_.due, slice_.turn
        record = SliceSnapshot(number, domain, [*key[1:]], holder, ended, *state)
        part[binding] = number, ended, msgspec.Raw(msgspec.msgpack.encode(record))

    def _encode(self, number: int) -> bytes:
        for reason in self._failed[number].values():
            return msgspec.msgpack.encode(reason)
        return msgspec.msgpack.encode(_Written([record for _, _, record in self._parts[number].values()]))


def restore_slices(
    slices: Slices,
    code: SpecificationCode,
    first: tuple[Sequence[Value], Sequence[Value]],
    records: Sequence[SliceSnapshot],
    *,
    types: Mapping[str, Type],
    fits: Callable[[Type, object], bool],
    time_ns: int,
) -> None:
    """Restore slices, and the initial values (`first`) of parameters and of own variables. Raises `ValueError`."""
    assert code.slicing is not None  # noqa: S101  it is parametric
    parameters = [kind for _, _, kind in code.slicing.parameters]
    own = [types[name] for name in code.slicing.own]

    def check(kinds: Sequence[Type], values: Sequence[object]) -> None:
        if len(kinds) != len(values) or not all(map(fits, kinds, values)):
            raise ValueError("the values of a slice differ from those of its specification")

    check(parameters, first[0])
    check(own, first[1])
    live: list[Slice] = []
    ended: list[tuple[Binding, str | None]] = []
    for record in sorted(records, key=lambda record: record.number):
        if not 0 <= record.domain < 1 << len(parameters):
            raise ValueError("a slice has a parameter that its specification does not have")
        check([kind for place, kind in enumerate(parameters) if record.domain >> place & 1], record.key)
        key = of_nan((True, *record.key))
        if record.ended:
            ended.append(((record.domain, key), record.holder))
            continue
        if len(record.runs) != len(code.properties):
            raise ValueError("the properties of a slice differ from those of its specification")
        check(own, record.values)
        runs = [
            run_of(declared.property, data, time_ns)
            for declared, data in zip(code.properties, record.runs, strict=True)
        ]
        slice_ = Slice(record.domain, key, tuple(runs), tuple(record.values), record.holder)
        slice_.due, slice_.turn = record.due, record.turn
        live.append(slice_)
    try:
        slices.restore(first[0], first[1], live, ended)
    except KeyError as error:
        raise ValueError("a slice has an impossible binding") from error
