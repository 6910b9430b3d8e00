"""Move the times in the state to this appliance's clocks when it takes over from the other one.

All ends move by the difference between both clocks, in one write, so that each duration has the same time left. If
this appliance did not follow the other one before, the difference may include time off. Then durations continue from
the last reading, so no block ends early, and the ends of tokens stay, because they are dates.
"""

import asyncio
from collections.abc import Callable

import msgspec

from appliance.base import clock
from appliance.control.operators.handled_alarms import silences_moved
from appliance.features.standby.replication import Pair
from appliance.specifications.timed_switches import returns_moved
from appliance.store.revisions import LIMITS, limit_moved
from appliance.store.state_file import StateStore

_SETTING = "reading of the clocks"
READ_SECONDS = 5.0
_SECOND = 1_000_000_000


class _Reading(msgspec.Struct, frozen=True):
    """The system clock (seconds since the epoch) and the age clock (nanoseconds) of an appliance."""

    appliance: str
    wall: float
    age: int


def adopt_times(store: StateStore, pair: Pair, age: Callable[[], int]) -> None:
    """Move the times if the other appliance was active. Call this before any part reads them."""
    text = store.settings().get(_SETTING)
    if text is None:
        return
    last = msgspec.json.decode(text, type=_Reading)
    if last.appliance == pair.membership.name:
        return
    elapsed = pair.away_seconds or 0.0
    now = _Reading(pair.membership.name, clock.wall(), age())
    shift, aged = now.wall - last.wall - elapsed, now.age - last.age - int(elapsed * _SECOND)
    settings = store.settings()
    with store.database.together():
        for block in store.hosts.blocks():
            if block.ends is not None:
                store.hosts.save_block(block._replace(ends=block.ends + aged))
        for name in LIMITS:
            store.save_setting(name, limit_moved(settings.get(name, ""), shift))
        returns_moved(store, shift)
        silences_moved(store, shift)
        for awaited in store.hosts.awaited():
            store.hosts.save_awaited(awaited._replace(expires=awaited.expires + shift))
        if pair.away_seconds is not None:
            store.save_tokens(*(row._replace(expires=row.expires + shift) for row in store.tokens()))
            tickets = store.doors.tickets()
            store.doors.save_tickets(*(row._replace(expires=row.expires + shift) for row in tickets))
        _save(store, now)


async def note_times(store: StateStore, pair: Pair, age_now: Callable[[], int]) -> None:
    while True:
        _save(store, _Reading(pair.membership.name, clock.wall(), age_now()))
        await asyncio.sleep(READ_SECONDS)


def _save(store: StateStore, reading: _Reading) -> None:
    store.save_setting(_SETTING, msgspec.json.encode(reading).decode())
