"""Keep the replica of a standby on the disk, and notice that a power cut may have taken its last changes.

After a reboot, this appliance takes over only once it has followed the active one again, or after `WAIT_SECONDS`
without an active one, because then both lost power together.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path

from appliance.base.atomic_files import write_whole
from appliance.features.standby.replica import Replica
from appliance.features.standby.witness import BOOT_ID

WAIT_SECONDS = 10.0
_SYNC_SECONDS = 0.1
_MARK = "replica-boot"


class ReplicaSync:
    """Syncs a replica. The file `replica-boot` in `folder` has the boot in which the replica was last complete."""

    def __init__(self, replica: Replica, folder: Path, boot: str | None = None) -> None:
        self._replica = replica
        self._mark = folder / _MARK
        self._boot = boot if boot is not None else Path(BOOT_ID).read_text("ascii").strip()

    async def run(self, followed: Callable[[], bool], complete: Callable[[], None]) -> None:
        """Sync the replica after each change, and call `complete` once no change can be missing.

        `followed()` returns whether the active appliance has sent the missing changes.
        """
        loop = asyncio.get_running_loop()
        end, marked, synced = loop.time() + WAIT_SECONDS, False, None
        while True:
            position = self._replica.position
            if position != synced:
                await asyncio.to_thread(self._replica.sync)
                synced = position
            if not marked and (self._is_complete() or followed() or loop.time() >= end):
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
