"""Translate the fields of a message to terms of z3: find, read and write them.

Positions and counts have 64 bits here, but are unbounded in the interpreter. A function without loops adds a few
products of a count below 2**32 and a size, which never exceed 64 bits.
"""

from functools import partial

import z3

from rosmop.form import nodes
from rosmop.prove.event_terms import CHANGED, DROPPED, MESSAGE, REPLACED, EventTerms, View
from rosmop.prove.number_terms import UnknownError, decode, parts
from rosmop.prove.terms import (
    State,
    Term,
    as_bits,
    both,
    choice,
    either,
    integer,
    number_at,
    opposite,
    with_number,
)
from rosmop.runtime.safe_messages import HEAD as SAFE_HEAD
from rosmop.runtime.values import struct_code, struct_size
from rosmop.runtime.wire import MAX_EMPTY
from rosmop.types import value_types
from rosmop.types.value_types import Type


def position(event: EventTerms, at: nodes.Spot, state: State) -> Term:
    offset = integer(at.offset, 64)
    return offset if at.base is None else state.term((event.active.frame, at.base)) + offset


def place_of(event: EventTerms, at: nodes.Spot, state: State) -> Term:
    offset = integer(at.offset, 32)
    return (
        offset if at.base is None else z3.Extract(31, 0, state.term((event.active.frame, at.base))) + offset
    )


def within(event: EventTerms, at: nodes.Spot, size: int, state: State) -> None:
    short = z3.ULT(z3.ZeroExt(32, event.beginning.size), position(event, at.plus(size), state))
    event.leave_to_python(state, short)


def text_length(event: EventTerms, at: nodes.Spot, state: State) -> Term:
    within(event, at, 4, state)
    return z3.ZeroExt(32, number_at(state.term(MESSAGE), place_of(event, at, state), 4))


def after_text(event: EventTerms, node: nodes.AfterText, state: State) -> None:
    length = text_length(event, node.at, state)
    state.slots[event.active.frame, node.name] = position(event, node.at.plus(4), state) + length


def count_elements(event: EventTerms, node: nodes.Count, state: State) -> None:
    state.slots[event.active.frame, node.name] = element_count(event, node.at, node.least, state)


def element_count(event: EventTerms, at: nodes.Spot, least: int, state: State) -> Term:
    count = text_length(event, at, state)
    room = z3.ZeroExt(32, event.beginning.size) - position(event, at.plus(4), state)
    many = z3.UGT(count * least, room) if least else z3.UGT(count, MAX_EMPTY)
    event.leave_to_python(state, many)
    return count


def after_elements(event: EventTerms, node: nodes.AfterElements, state: State) -> None:
    count = (
        integer(node.count, 64)
        if isinstance(node.count, int)
        else state.term((event.active.frame, node.count))
    )
    state.slots[event.active.frame, node.name] = position(event, node.at, state) + count * node.size


def ends_at(event: EventTerms, node: nodes.Ends, state: State) -> None:
    end = position(event, node.at, state)
    event.leave_to_python(state, end != z3.ZeroExt(32, event.beginning.size))


def read_numbers(event: EventTerms, node: nodes.ReadNumbers, state: State) -> None:
    within(event, node.at, max(offset + size_of(event, kind) for _, kind, offset in node.fields), state)
    for name, kind, offset in node.fields:
        place = place_of(event, node.at.plus(offset), state)
        state.slots[event.active.frame, name] = number(event, state.term(MESSAGE), place, kind)


def number(event: EventTerms, message: Term, place: Term, kind: Type) -> Term:
    return decode(number_at(message, place, size_of(event, kind)), kind)


def size_of(event: EventTerms, kind: Type) -> int:
    code = struct_code(kind)
    if code is not None:
        return struct_size(code)
    if isinstance(kind, value_types.RecordType):
        return sum(map(partial(size_of, event), event.values.fields(kind)))
    if isinstance(kind, value_types.VectorType) and kind.length is not None:
        return kind.length * size_of(event, kind.element)
    raise UnknownError(f"a value of type {kind} in a vector or message")


def read_value(event: EventTerms, node: nodes.ReadValue, state: State) -> None:
    kind, start = node.type, position(event, node.at, state)
    count, size = integer(1, 64), 1
    if isinstance(kind, value_types.StringType):
        count = text_length(event, node.at, state)
        start = position(event, node.at.plus(4), state)
        event.leave_to_python(state, z3.UGT(start + count, z3.ZeroExt(32, event.beginning.size)))
    elif isinstance(kind, value_types.VectorType) and kind.length is None:
        size = size_of(event, kind.element)
        count = element_count(event, node.at, size, state)
        start = position(event, node.at.plus(4), state)
    else:
        size = size_of(event, kind)
        within(event, node.at, size, state)
        if isinstance(kind, value_types.VectorType):
            count, size = integer(kind.length or 0, 64), size_of(event, kind.element)
    state.slots[event.active.frame, node.name] = View(state.term(MESSAGE), start, count)
    state.slots[event.active.frame, node.end] = start + count * size


def write_back(event: EventTerms, node: nodes.WriteBack, state: State) -> None:
    dropped = state.term(DROPPED)
    event.exit(state.where(dropped), True)
    state.require(opposite(dropped))
    if event.safe is not None:
        replaced = state.term(REPLACED)
        stopped = state.where(replaced)
        put_safe(event.safe, stopped)
        event.exit(stopped, True)
        state.require(opposite(replaced))
    puts = []
    for write in node.writes:
        flag = state.term((event.active.frame, write.flag))
        if write.end is not None:
            event.ignore(state.where(flag), "a string or vector that is written")
            state.require(opposite(flag))
            continue
        wanted = state.where(flag)
        bits = bits_of(event, event.term(write.value, wanted), write.value.type, wanted)
        state.alive = either(wanted.alive, state.where(opposite(flag)).alive)
        puts.append((flag, bits, place_of(event, write.at, state)))
    for flag, bits, place in puts:
        message = state.term(MESSAGE)
        differs = both(flag, number_at(message, place, bits.size() // 8) != bits)
        state.slots[MESSAGE] = choice(differs, with_number(message, place, bits), message)
        state.slots[CHANGED] = either(state.term(CHANGED), differs)


def put_safe(safe: nodes.SafeMessage, state: State) -> None:
    message, changed = state.term(MESSAGE), state.term(CHANGED)
    place = SAFE_HEAD if safe.stamped else 0
    while place < len(safe.data):  # the largest numbers that fit, as in the module, so that terms are alike
        size = next(size for size in (8, 4, 2, 1) if place + size <= len(safe.data))
        new = integer(int.from_bytes(safe.data[place : place + size], "little"), 8 * size)
        differs = opposite(number_at(message, integer(place, 32), size) == new)
        message = choice(differs, with_number(message, integer(place, 32), new), message)
        changed = either(changed, differs)
        place += size
    state.slots |= {MESSAGE: message, CHANGED: changed}


def bits_of(event: EventTerms, value: Term, kind: Type, state: State) -> Term:
    if isinstance(kind, value_types.FloatingType):
        event.leave_to_python(state, z3.fpIsNaN(value))
        return z3.fpToIEEEBV(value)
    if isinstance(kind, value_types.BoolType):
        return as_bits(value, 8)
    if isinstance(kind, value_types.IntegerType):
        return z3.Extract(kind.bits - 1, 0, value)
    seconds, rest = parts(value)
    least, most = (0, 1 << 32) if kind == value_types.TIME else (-(1 << 31), 1 << 31)
    event.leave_to_python(state, either(seconds < least, seconds >= most))
    return z3.Concat(z3.Extract(31, 0, rest), z3.Extract(31, 0, seconds))
