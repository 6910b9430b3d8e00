"""Keep the ends of tokens across restarts, even if the system clock is set back while the appliance is off."""

import asyncio
import contextlib

from appliance.base.deadlines import Deadlines
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError

_SAVE_SECONDS = 30.0


class StoredDeadlines(Deadlines):
    """Ends whose remaining time is stored, so that a restart never extends it."""

    def __init__(self, store: StateStore) -> None:
        super().__init__()
        self._store = store
        self._stored = store.time_left()
        self.limit(self._stored)

    def save(self) -> None:
        """Save the remaining times. Raises `StoreError`."""
        changed = {name: left for name, left in self.left().items() if self._stored.get(name) != left}
        if changed:
            self._store.database.require_room()
            self._store.save_time_left(changed)
            self._stored |= changed

    def forget(self, name: str) -> None:
        super().forget(name)
        if self._stored.pop(name, None) is not None:
            self._store.forget_time_left(name)

    async def watch(self) -> None:
        while True:
            await asyncio.sleep(_SAVE_SECONDS)
            with contextlib.suppress(StoreError):  # a full disk: the next save tries again
                self.save()
