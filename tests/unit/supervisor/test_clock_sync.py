import ctypes
from typing import Any

import pytest

from appliance.supervisor import clock_sync
from appliance.supervisor.clock_sync import clock_is_synchronised


@pytest.mark.parametrize(
    ("status", "answer", "expected"),
    [(0x0041, 5, False), (0x2001, 0, True), (0, 5, True), (0, -1, None), (0x0040, -1, None)],
)
def test_the_kernels_flag_decides(
    monkeypatch: pytest.MonkeyPatch, status: int, answer: int, expected: bool | None
) -> None:
    """Other flags are ignored. If the call is forbidden, the state is unknown. The clock is never set."""
    asked = []

    def adjtimex(given: Any) -> int:
        asked.append(given.contents.modes)
        given.contents.status = status
        return answer

    monkeypatch.setattr("appliance.supervisor.clock_sync._libc.adjtimex", adjtimex)
    assert clock_is_synchronised() is expected
    assert asked == [0]


def test_the_structure_is_the_kernels() -> None:
    assert clock_sync.Timex.status.offset == 40
    assert ctypes.sizeof(clock_sync.Timex) >= 208


def test_this_kernel_is_asked() -> None:
    timex = clock_sync.Timex()
    answer = ctypes.CDLL(None).adjtimex(ctypes.pointer(timex))
    assert answer == -1 or timex.maxerror > 0
    assert clock_is_synchronised() is (None if answer == -1 else not timex.status & 0x0040)
