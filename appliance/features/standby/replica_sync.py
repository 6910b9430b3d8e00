"""Keep the replica of a standby on the disk, and notice that a power cut may have taken its last changes.

After a reboot, this appliance takes over only once one of these shows that no acknowledged change is missing:

1. It has followed the active appliance again.
2. The witness's in-sync set names only this appliance.
3. The other appliance is not active either, and does not have more changes (`StateComparison`). If both have the same
   ones, the last holder of the lease takes over, because its monitors need not hold their topics.
4. No appliance has held the lease for `WAIT_SECONDS`: both lost power together, and the other one cannot be asked.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.features.standby.lease_link import LeaseState
from appliance.features.standby.replica import Replica
from appliance.features.standby.replication_frames import (
    FromStandby,
    ReplicationError,
    ReplicationLink,
    Stored,
    reason_of,
)
from appliance.features.standby.witness.lease_file import BOOT_ID

INCOMPLETE = "it has restarted with its machine, and has not followed the active appliance since"
"""The obstacle of a standby that may lack the last changes, because its machine lost its power."""

WAIT_SECONDS = 10.0
_SYNC_SECONDS = 0.1
_POSITION_SECONDS = 5.0
MARK = "replica-boot"


class ReplicaSync:
    """Syncs a replica. The file `replica-boot` in `folder` has the boot in which the replica was last complete."""

    def __init__(self, replica: Replica, folder: Path, boot: str | None = None) -> None:
        self._replica = replica
        self._mark = folder / MARK
        self._boot = boot if boot is not None else Path(BOOT_ID).read_text("ascii").strip()

    async def run(self, recovered: Callable[[], bool], complete: Callable[[], None]) -> None:
        """Sync the replica after each change, and call `complete` once no change can be missing.

        `recovered()` returns whether no change can be missing although the machine has restarted.
        """
        marked, synced = False, None
        while True:
            position = self._replica.position
            if position != synced:
                await asyncio.to_thread(self._replica.sync)
                synced = position
            if not marked and (self._is_complete() or recovered()):
                await asyncio.to_thread(write_whole, self._mark, self._boot.encode("ascii"), 0o600)
                marked = True
                complete()
            await asyncio.sleep(_SYNC_SECONDS)

    def _is_complete(self) -> bool:
        """Return whether the machine has not restarted since the mark; a new replica is complete."""
        try:
            return self._mark.read_text("ascii") == self._boot
        except FileNotFoundError:
            return True


class StateComparison:
    """Answers the other appliance, which follows this one although it is not active, and compares the states."""

    def __init__(self, own: Callable[[], Stored]) -> None:
        self._own = own
        self._ahead: int | None = None  # by how many changes this appliance had more

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        link: ReplicationLink[FromStandby] = ReplicationLink(reader, writer, FromStandby)
        try:
            other = await link.receive(_POSITION_SECONDS)
            own = self._own()
            if isinstance(other, Stored) and own.history and other.history == own.history:
                self._ahead = own.number - other.number
            await link.send(reason_of(ReplicationError("this appliance is not active either")))
        finally:
            await link.close()

    def has_most(self, *, held_last: bool) -> bool:
        return self._ahead is not None and self._ahead >= (0 if held_last else 1)


def is_recovered(name: str, lease: LeaseState | None, comparison: StateComparison, *, followed: bool) -> bool:
    if followed or lease is None:
        return followed
    waited = lease.expired_since is not None and clock.since_boot() - lease.expired_since >= WAIT_SECONDS
    return lease.sole or waited or comparison.has_most(held_last=lease.holder in ("", name))
