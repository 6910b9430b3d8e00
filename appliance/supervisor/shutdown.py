"""End all processes in less than five seconds: a message first, then SIGTERM, then SIGKILL."""

import asyncio
import signal
from collections.abc import Sequence
from contextlib import suppress

import structlog

from appliance.channel.messages import Stop
from appliance.supervisor.process_slot import ProcessSlot

_STOP_SECONDS = 3.0
_TERMINATE_SECONDS = 0.3
_LAST_SECONDS = 1.0

log = structlog.get_logger()


async def end_all(slots: Sequence[ProcessSlot], process_died: asyncio.Event, *, failed: bool = False) -> None:
    """End all processes; no process may start. `process_died` is set after each death, when its slot is free."""
    stop = Stop(failed)
    for slot in slots:
        if slot.due is not None:
            slot.due.cancel()
    await _end([slot for slot in slots if not slot.role.outlives_control], stop, _STOP_SECONDS, process_died)
    await _end(slots, stop, _LAST_SECONDS, process_died)


async def _end(slots: Sequence[ProcessSlot], stop: Stop, seconds: float, process_died: asyncio.Event) -> None:
    for slot in slots:
        if slot.process is None:
            continue
        if slot.process.is_program:
            slot.process.kill(signal.SIGTERM)
        else:
            slot.process.send(stop)
    if await _all_gone(slots, seconds, process_died):
        return
    _signal(slots, signal.SIGTERM)
    if await _all_gone(slots, _TERMINATE_SECONDS, process_died):
        return
    _signal(slots, signal.SIGKILL)
    await _all_gone(slots, _LAST_SECONDS, process_died)


def _signal(slots: Sequence[ProcessSlot], number: signal.Signals) -> None:
    for slot in slots:
        if slot.process is not None:
            log.warning("process did not stop", role=slot.role.name, pid=slot.process.pid, signal=number.name)
            slot.process.kill(number)


async def _all_gone(slots: Sequence[ProcessSlot], seconds: float, process_died: asyncio.Event) -> bool:
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while any(slot.process is not None for slot in slots):
                process_died.clear()
                await process_died.wait()
    return all(slot.process is None for slot in slots)
