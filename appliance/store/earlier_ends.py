"""Read the ends that versions up to 0.3.0 stored in seven places, once, when this version first opens the state."""

from collections.abc import Iterator

import msgspec

from appliance.store.state_file import EndRow, StateStore

_SECOND = 1_000_000_000
_LONGEST_SECONDS = 4e9  # in nanoseconds, a longer time is beyond SQLite's integers


class _Return(msgspec.Struct):
    until: float
    seconds: float


class _Silence(msgspec.Struct):
    until: float | None


def earlier_ends(store: StateStore, wall: float, age: int) -> list[EndRow]:
    """Return the ends by an age clock that showed `age` when its system clock showed `wall`."""
    rows = [
        EndRow(kind, name, age + _nanoseconds(seconds), age, 0, None if date is None else _nanoseconds(date))
        for kind, name, seconds, date in _rights(store, wall)
    ]
    blocks = store.database.query("SELECT address, ends FROM host_block WHERE ends IS NOT NULL")
    return rows + [EndRow("block", address, at, age, 1) for address, at in blocks]


def _nanoseconds(seconds: float) -> int:
    return int(min(seconds, _LONGEST_SECONDS) * _SECOND)


def _rights(store: StateStore, wall: float) -> Iterator[tuple[str, str, float, float | None]]:
    """Return kinds, names, the seconds that are left, and the dates of credentials in seconds since the epoch."""
    query = store.database.query
    for kind, rows in (
        ("token", "SELECT id, id, expires FROM token WHERE revoked IS NULL"),
        ("door ticket", "SELECT id, id, expires FROM door_ticket"),
        ("enrolment", "SELECT name, id, expires FROM enrolment_token"),
    ):
        limits = dict(query("SELECT id, seconds FROM token_left"))
        for name, number, expires in query(rows):
            yield kind, name, min(expires - wall, limits.get(number, expires - wall)), expires
    settings = store.settings()
    for name in ("confirm", "confirm monitors"):
        if text := settings.get(name):
            back_to, deadline, length = text.split()
            yield name, back_to, min(float(deadline) - wall, float(length)), None
    returns = msgspec.json.decode(settings.get("monitor returns", "{}"), type=dict[str, _Return])
    for name, back in returns.items():
        yield "timed switch", name, min(back.until - wall, back.seconds), None
    silences = msgspec.json.decode(settings.get("handled alarms", "{}"), type=dict[str, _Silence])
    for name, silence in silences.items():
        if silence.until is not None:
            yield "silence", name, silence.until - wall, None
