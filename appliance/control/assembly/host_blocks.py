"""Keep the hosts that operators block, with the ends of their blocks. The policy denies all their requests.

1. A block is stored before it takes effect, and survives restarts of control and of the appliance.
2. A block ends by the age clock (`base/age_clock.py`): changes of the system clock neither end nor extend it.
3. `reasons` is never changed, only replaced, so a policy keeps the blocks with which it was put into force.
"""

from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime

from appliance.base import clock
from appliance.channel.answers.status import BlocksState
from appliance.policy.model import Address, address_of
from appliance.store.host_tables import HostBlockRow
from appliance.store.state_file import StateStore

_SECOND = 1_000_000_000
_NOTE_SHOWN = 60  # characters; the reason of a decision is bounded


class HostUses:
    """How hosts use the appliance besides their nodes: sessions, followers, doors. A block ends all of them.

    Each part of control that has some adds a function, which names them.
    """

    def __init__(self) -> None:
        self._parts: list[Callable[[Address], Iterable[str]]] = []

    def add(self, of: Callable[[Address], Iterable[str]]) -> None:
        self._parts.append(of)

    def of(self, host: Address) -> list[str]:
        return [use for part in self._parts for use in part(host)]


class BlockTable:
    """All blocks, by canonical address; `age()` is the age clock, and `dated` corrects its earlier dates."""

    def __init__(self, store: StateStore, age: Callable[[], int], dated: Callable[[int], int] = int) -> None:
        self._store = store
        self._age = age
        self._dated = dated
        self._put: dict[Address, int] = {}  # the dates of blocks that this process has put
        self._rows = {address_of(row.address): row for row in store.hosts.blocks()}
        self._now, self._wall, self._seen = age() if self._rows else 0, clock.wall(), clock.since_boot_ns()
        self.reasons: Mapping[Address, str] = self._described()
        self.uses = HostUses()
        self._listeners: list[Callable[[], None]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def on_change(self, changed: Callable[[], None]) -> None:
        self._listeners.append(changed)

    def rows(self) -> dict[Address, HostBlockRow]:
        return dict(self._rows)

    def read_clock(self) -> None:
        """Read the age clock, which may write a file. Only one thread at a time may call this."""
        self._now, self._wall, self._seen = self._age(), clock.wall(), clock.since_boot_ns()

    def _move_ends(self) -> None:
        """Move the ends of blocks that were put while a long gap of the age clock did not count yet."""
        for address, date in list(self._put.items()):
            moved = self._dated(date) - date
            if moved:
                row = self._rows[address]
                self._put[address] = date + moved
                self._rows[address] = row._replace(ends=None if row.ends is None else row.ends + moved)
                self._store.hosts.save_block(self._rows[address])

    def state(self) -> BlocksState:
        ends = [self.until(row) for row in self._rows.values()]
        return BlocksState(len(ends), min((end for end in ends if end is not None), default=None))

    def age_now(self) -> int:
        return self._now + clock.since_boot_ns() - self._seen

    def until(self, row: HostBlockRow) -> float | None:
        """Return the end by the present system clock, or None if the block has no end."""
        return None if row.ends is None else self._wall + (row.ends - self._now) / _SECOND

    def put(self, address: Address, *, seconds: float | None, who: str, note: str) -> HostBlockRow:
        row = self.planned(address, seconds, who, note)
        self._store.hosts.save_block(row)
        self._rows.pop(address, None)
        self._rows[address] = row
        self._put[address] = self._now
        self._changed()
        return row

    def planned(self, address: Address, seconds: float | None, who: str, note: str) -> HostBlockRow:
        ends = None if seconds is None else self._now + int(seconds * _SECOND)
        return HostBlockRow(str(address), clock.wall(), ends, who, note)

    def take(self, address: Address) -> HostBlockRow | None:
        row = self._rows.get(address)
        if row is not None:
            self._store.hosts.forget_block(row.address)
            del self._rows[address]
            self._put.pop(address, None)
            self._changed()
        return row

    def due(self) -> list[Address]:
        self._move_ends()
        return [
            address for address, row in self._rows.items() if row.ends is not None and row.ends <= self._now
        ]

    def seconds_left(self) -> float | None:
        self._move_ends()
        ends = [row.ends for row in self._rows.values() if row.ends is not None]
        return max(0.0, (min(ends) - self._now) / _SECOND) if ends else None

    def _changed(self) -> None:
        self.reasons = self._described()
        for changed in self._listeners:
            changed()

    def _described(self) -> dict[Address, str]:
        return {address: self._description(row) for address, row in self._rows.items()}

    def _description(self, row: HostBlockRow) -> str:
        until = self.until(row)
        end = "" if until is None else f" until {in_utc(until)}"
        note = row.note if len(row.note) <= _NOTE_SHOWN else f"{row.note[: _NOTE_SHOWN - 1]}…"
        about = f": {note}" if note else ""
        return f"blocked by {row.who}{end}{about}; lift it with `rosrv host unblock {row.address}`"


def in_utc(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%SZ")
