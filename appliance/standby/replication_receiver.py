"""Take the changes of the active appliance, and acknowledge each message once it is on the disk."""

import asyncio
from collections.abc import Callable

from appliance.standby.replica import Replica
from appliance.standby.replication_frames import (
    Changes,
    FromActive,
    Refused,
    ReplicationError,
    ReplicationLink,
    SnapshotBegin,
    SwitchoverWanted,
    reason_of,
)
from appliance.store.writer_thread import StoreError

_SILENCE_SECONDS = 10.0  # the active appliance sends something every second


class ReplicationReceiver:
    """The standby's end; `accepts` decides whether an appliance of this epoch may be the active one."""

    def __init__(self, replica: Replica, accepts: Callable[[int], bool]) -> None:
        self._replica = replica
        self._accepts = accepts
        self._link: ReplicationLink[FromActive] | None = None

    async def want_switchover(self) -> None:
        """Ask the active appliance to hand over. Raises `ReplicationError` if it is not connected."""
        if self._link is None:
            raise ReplicationError("the active appliance is not connected")
        await self._link.send(SwitchoverWanted())

    async def follow(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Take changes until the link ends. Raises `ReplicationError`, and `StoreError` if the disk is full."""
        link: ReplicationLink[FromActive] = ReplicationLink(reader, writer, FromActive)
        try:
            await link.send(self._replica.position)
            self._link = link
            while True:
                message = await link.receive(_SILENCE_SECONDS)
                if isinstance(message, Refused):
                    raise ReplicationError(f"the active appliance refuses: {message.reason}")
                try:
                    self._require_accepted(message)
                    await asyncio.to_thread(self._replica.take, message)
                except (ReplicationError, StoreError) as error:
                    await link.send(reason_of(error))
                    raise
                await link.send(self._replica.position)
        finally:
            self._link = None
            await link.close()
            await asyncio.to_thread(self._replica.abandon_snapshot)

    def _require_accepted(self, message: FromActive) -> None:
        if isinstance(message, Changes | SnapshotBegin) and not self._accepts(message.epoch):
            raise ReplicationError(f"an appliance of epoch {message.epoch} is not accepted as the active one")
