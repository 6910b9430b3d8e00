"""If a process is killed at any write, the memory has the state before or after the write, and no other."""

from collections.abc import Callable
from typing import Any

import pytest

from appliance.relay.monitors.state_memory import StateMemory, StoredState, read

SIZE = 8192


class Written:
    def __init__(self, data: bytearray) -> None:
        self.data = data
        self.stores: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: Any) -> Any:
        return self.data[index]

    def __setitem__(self, index: Any, value: Any) -> None:
        if isinstance(index, slice):
            self.stores += zip(range(*index.indices(len(self.data))), value, strict=True)
        else:
            self.stores.append((index, value))
        self.data[index] = value


def killed_anywhere(data: bytearray, act: Callable[[Any], object]) -> list[StoredState | None]:
    torn, written = bytearray(data), Written(data)
    act(written)
    found = [read(torn)]
    for at, value in written.stores:
        torn[at] = value
        found.append(read(torn))
    assert torn == data
    return found


def write_both(memory: StateMemory) -> None:
    memory.write_cells(1, b"........")
    memory.write_base(1, b"base")


ACTS: dict[str, Callable[[StateMemory], object]] = {
    "a base": lambda memory: memory.write_base(0, b"another state, longer than the one before"),
    "cells": lambda memory: memory.write_cells(1, b"CELLS..."),
    "all": lambda memory: memory.lay_out(b"new head", [(b"x" * 300, 16), (b"y", 0), (b"", 8)]),
    "a base after cells": write_both,
}


@pytest.mark.parametrize("act", ACTS)
@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_a_kill_leaves_what_was_before_or_after(act: str, rounds: int) -> None:
    data = bytearray(SIZE)
    memory = StateMemory(written := Written(data))
    assert memory.lay_out(b"head", [(b"one", 0), (b"two", 8)])
    for number in range(rounds):
        memory.write_base(0, b"one, round %d" % number)
        memory.write_cells(1, b"cells %2d" % number)
    before = bytearray(data)
    written.stores.clear()
    ACTS[act](memory)
    torn, states = bytearray(before), [read(before)]
    for at, value in written.stores:
        torn[at] = value
        if (state := read(torn)) != states[-1]:
            states.append(state)
    assert torn == data
    steps = 3 if act == "a base after cells" else 2
    assert len(states) == steps
    assert states[-1] == read(data)


def test_the_first_kill_leaves_nothing_or_all() -> None:
    states = killed_anywhere(bytearray(SIZE), lambda one: StateMemory(one).lay_out(b"head", [(b"one", 0)]))
    assert set(map(repr, states)) == {"None", repr(StoredState(b"head", [(b"one", None)]))}


def test_a_state_without_room_changes_nothing() -> None:
    data = bytearray(SIZE)
    memory = StateMemory(data)
    assert memory.lay_out(b"head", [(b"one", 0)])
    before = bytes(data)
    assert not memory.write_base(0, bytes(2000))
    assert not memory.lay_out(b"head", [(bytes(2000), 0)])
    assert bytes(data) == before


@pytest.mark.parametrize("place", range(0, 200, 3))
def test_arbitrary_bytes_are_refused(place: int) -> None:
    data = bytearray(SIZE)
    StateMemory(data).lay_out(b"head", [(b"one", 8), (b"two", 0)])
    for value in (0, 1, 3, 0x7F, 0xFF):
        wrong = bytearray(data)
        wrong[place] = value
        try:
            read(wrong)
        except ValueError:
            continue
    with pytest.raises(ValueError):
        read(data[:64])
