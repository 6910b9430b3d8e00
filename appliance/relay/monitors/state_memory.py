"""Lay out a file of fixed size that keeps monitors' state when a relay dies; the supervisor opens the file.

The file contains a magic number, a byte with the valid half (1 or 2; 0: none), and two halves. A half contains a
`head` (the writer's data), a table, and *sections*. A section contains two places for the `base` state of a group of
monitors, two for its `cells`, and one byte that marks the valid places. A writer changes only invalid places, and
then the byte. Stores of one thread become visible in order, so a process killed at any point leaves the state before
or after a write. A power cut can lose this order, so the reader sees from the head whether the machine has restarted.
"""

import mmap
import os
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

from appliance.relay.transport.pump import BASE, CELLS, HAS_CELLS

MAGIC = b"rosrvMS1"
MAX_SECTIONS = 100_000

_START = 16
_ROOT = len(MAGIC)
_HEAD = struct.Struct("<II")  # length of the head, number of sections
_ROW = struct.Struct("<III")  # for a section: its start in its half, space for `base`, size of `cells`
_LENGTH = struct.Struct("<I")
_FLAGS = 16  # bytes before the places of a section: the section's byte, and from byte 8 on the lengths of both bases
_LEAST_ROOM, _MAX_SPARE = 256, 8192

Memory = Any
"""A view of a mapped file, or other memory that is read and written by slices."""


class StoredState(NamedTuple):
    """The head, and each section's base, with its cells if they are newer than the base."""

    head: bytes
    sections: list[tuple[bytes, bytes | None]]


class CellsPlace(NamedTuple):
    """Where the cells of a section are in its memory, for the pump, which writes them as `write_cells` does.

    `flags` is the position of the section's byte (negative: nothing is kept), and `cells` has both places.
    """

    memory: Memory
    flags: int
    cells: tuple[int, int]


NOT_KEPT = CellsPlace(memoryview(bytearray(1)), -1, (0, 0))


class StateMemory:
    """Writes into a memory; its old content stays valid until the first `lay_out` is complete."""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._valid = 0 if bytes(memory[:_ROOT]) != MAGIC else memory[_ROOT]
        self._sections: list[_Section] = []

    def lay_out(self, head: bytes, sections: Sequence[tuple[bytes, int]]) -> bool:
        half = (len(self._memory) - _START) // 2
        rows, at = [], _HEAD.size + len(head) + _ROW.size * len(sections)
        for base, cells in sections:
            at = _even(at)
            room = max(_LEAST_ROOM, _even(len(base) + min(len(base), _MAX_SPARE)))
            rows.append((at, room, cells))
            at += _size(room, cells)
        if at > half or len(sections) > MAX_SECTIONS:
            return False
        memory, into = self._memory, 2 if self._valid == 1 else 1
        first = _START + (into - 1) * half
        table = _HEAD.pack(len(head), len(sections)) + head + b"".join(_ROW.pack(*row) for row in rows)
        memory[first : first + len(table)] = table
        made = [_Section(memory, first + at, room, cells) for at, room, cells in rows]
        for section, (base, _) in zip(made, sections, strict=True):
            section.begin(base)
        if self._valid == 0:
            memory[:_ROOT] = MAGIC
        memory[_ROOT] = self._valid = into
        self._sections = made
        return True

    def write_base(self, section: int, base: bytes) -> bool:
        return self._sections[section].write_base(base)

    def write_cells(self, section: int, cells: bytes) -> None:
        self._sections[section].write_cells(cells)

    def has_cells(self, section: int) -> bool:
        return self._sections[section].has_cells

    def cells_place(self, section: int) -> CellsPlace:
        """Return the places where the pump writes a section's cells; they are valid until the next `lay_out`."""
        return self._sections[section].cells_place


class _Section:
    def __init__(self, memory: Memory, at: int, room: int, cells: int) -> None:
        self._memory = memory
        self._at = at
        self._room = room
        first = at + _FLAGS
        self._bases = first, first + room
        self._cells = first + 2 * room, first + 2 * room + _even(cells)
        self._size = cells

    def begin(self, base: bytes) -> None:
        self._put(0, base)
        self._memory[self._at] = 0

    @property
    def has_cells(self) -> bool:
        return bool(self._memory[self._at] & HAS_CELLS)

    @property
    def cells_place(self) -> CellsPlace:
        return CellsPlace(self._memory, self._at, self._cells)

    def write_base(self, base: bytes) -> bool:
        if len(base) > self._room:
            return False
        into = self._memory[self._at] & BASE ^ BASE
        self._put(into, base)
        self._memory[self._at] = into
        return True

    def write_cells(self, cells: bytes) -> None:
        flags = self._memory[self._at]  # the pump writes it as well
        valid = self._cells[(flags & CELLS) >> 1]
        if flags & HAS_CELLS and self._memory[valid : valid + self._size] == cells:
            return
        into = flags & CELLS ^ CELLS
        at = self._cells[into >> 1]
        self._memory[at : at + self._size] = cells
        self._memory[self._at] = flags & BASE | into | HAS_CELLS

    def _put(self, place: int, base: bytes) -> None:
        memory, at = self._memory, self._bases[place]
        memory[at : at + len(base)] = base
        length = self._at + 8 + _LENGTH.size * place
        memory[length : length + _LENGTH.size] = _LENGTH.pack(len(base))


def map_memory(descriptor: int, *, writable: bool) -> memoryview:
    access = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
    memory = mmap.mmap(descriptor, 0, flags=mmap.MAP_SHARED, prot=access)
    os.close(descriptor)
    return memoryview(memory)


def read(memory: Memory) -> StoredState | None:
    """Return the valid state, or None without one. Raises `ValueError` if the memory is malformed."""
    if len(memory) < _START or bytes(memory[:_ROOT]) != MAGIC or memory[_ROOT] == 0:
        return None
    half = (len(memory) - _START) // 2
    if memory[_ROOT] > 2:
        raise ValueError("the memory has no such half")
    first = _START + (memory[_ROOT] - 1) * half
    view = memoryview(memory)[first : first + half].toreadonly()
    try:
        size, count = _HEAD.unpack_from(view)
        if count > MAX_SECTIONS:
            raise ValueError(f"the memory has {count} sections")
        head = bytes(_part(view, _HEAD.size, size))
        table = _HEAD.size + size
        return StoredState(
            head, [_read(view, *_ROW.unpack_from(view, table + _ROW.size * row)) for row in range(count)]
        )
    except struct.error as error:
        raise ValueError(f"the memory is cut: {error}") from error


def _read(view: memoryview, at: int, room: int, cells: int) -> tuple[bytes, bytes | None]:
    flags = _part(view, at, _FLAGS)[0]
    place = flags & BASE
    (length,) = _LENGTH.unpack_from(view, at + 8 + _LENGTH.size * place)
    if length > room:
        raise ValueError("a state is longer than its place")
    base = bytes(_part(view, at + _FLAGS + place * room, length))
    if not flags & HAS_CELLS:
        return base, None
    second = _even(cells) if flags & CELLS else 0
    return base, bytes(_part(view, at + _FLAGS + 2 * room + second, cells))


def _part(view: memoryview, at: int, size: int) -> memoryview:
    if at + size > len(view):
        raise ValueError("a state ends beyond the memory")
    return view[at : at + size]


def _size(room: int, cells: int) -> int:
    return _FLAGS + 2 * room + 2 * _even(cells)


def _even(size: int) -> int:
    return -(-size // 8) * 8
