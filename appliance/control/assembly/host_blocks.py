"""Keep the hosts that operators block, with the ends of their blocks. The policy denies all their requests.

1. A block is stored before it takes effect, and survives restarts of control and of the appliance.
2. A block is never too short, even if the system clock was wrong at a start.
3. `reasons` is never changed, only replaced, so a policy keeps the blocks with which it was put into force.
"""

from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime

from appliance.base import clock
from appliance.channel.answers.status import BlocksState
from appliance.policy.model import Address, address_of
from appliance.store.ends import EndKind, EndTable
from appliance.store.host_tables import HostBlockRow
from appliance.store.state_file import StateStore

BLOCKS = EndKind("block", late=True)
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
    """All blocks, by canonical address."""

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        self._store = store
        self._ends = ends
        self._rows = {address_of(row.address): row for row in store.hosts.blocks()}
        self.reasons: Mapping[Address, str] = self._describe()
        self.uses = HostUses()
        self._listeners: list[Callable[[], None]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def on_change(self, changed: Callable[[], None]) -> None:
        self._listeners.append(changed)

    def rows(self) -> dict[Address, HostBlockRow]:
        return dict(self._rows)

    def state(self) -> BlocksState:
        ends = [self.until(row) for row in self._rows.values()]
        return BlocksState(len(ends), min((end for end in ends if end is not None), default=None))

    def until(self, row: HostBlockRow) -> float | None:
        """Return the end by the present system clock, or None if the block has no end."""
        return self._ends.date(BLOCKS, row.address)

    def put(self, address: Address, *, seconds: float | None, who: str, note: str) -> HostBlockRow:
        row = HostBlockRow(str(address), clock.wall(), who, note)
        with self._store.database.together():
            if seconds is None:
                self._ends.forget(BLOCKS, row.address)
            else:
                self._ends.set(BLOCKS, row.address, seconds)
            self._store.hosts.save_block(row)
        self._rows.pop(address, None)
        self._rows[address] = row
        self._changed()
        return row

    def take(self, address: Address) -> HostBlockRow | None:
        row = self._rows.get(address)
        if row is not None:
            with self._store.database.together():
                self._store.hosts.forget_block(row.address)
                self._ends.forget(BLOCKS, row.address)
            del self._rows[address]
            self._changed()
        return row

    def _changed(self) -> None:
        self.reasons = self._describe()
        for changed in self._listeners:
            changed()

    def _describe(self) -> dict[Address, str]:
        return {address: self._description(row) for address, row in self._rows.items()}

    def _description(self, row: HostBlockRow) -> str:
        until = self.until(row)
        end = "" if until is None else f" until {in_utc(until)}"
        note = row.note if len(row.note) <= _NOTE_SHOWN else f"{row.note[: _NOTE_SHOWN - 1]}…"
        about = f": {note}" if note else ""
        return f"blocked by {row.who}{end}{about}; lift it with `rosrv host unblock {row.address}`"


def in_utc(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%SZ")
