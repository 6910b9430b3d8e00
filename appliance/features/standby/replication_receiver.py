"""Take the changes of the active appliance, and acknowledge each message once it is stored."""

import asyncio
from collections.abc import Callable

from appliance.features.standby.replica import Replica
from appliance.features.standby.replication_frames import (
    Changes,
    FromActive,
    Introduction,
    LastRefusal,
    Refused,
    ReplicationError,
    ReplicationLink,
    SnapshotBegin,
    SnapshotEnd,
    SwitchoverRefused,
    SwitchoverWanted,
    obstacle_of,
    reason_of,
)
from appliance.specifications.switches import SWITCHES
from appliance.store.changes import Change, Put
from appliance.store.state_file import REVISION_TABLES
from appliance.store.writer_thread import StoreError

_INTRODUCED_SECONDS = 3600.0
_FEW = 16  # changes
_SMALL = 16 << 10  # bytes of one value
_REFUSAL_SECONDS = 7.0  # the active appliance refuses after 4.4 s, and gives up after 2.5 s of a pause
_SILENCE_SECONDS = 10.0  # the active appliance sends something every second


class ReplicationReceiver:
    """The standby's end of the replication."""

    def __init__(
        self,
        replica: Replica,
        accepts: Callable[[int], bool],  # whether an appliance of this epoch may be the active one
        introduction: Callable[[], Introduction | None] = lambda: None,
        obstacle: Callable[[], str] = lambda: "",
        revised: Callable[[], None] = lambda: None,  # called after a change of policy or specifications
    ) -> None:
        self._replica = replica
        self._accepts = accepts
        self._link: ReplicationLink[FromActive] | None = None
        self.refusal = LastRefusal()
        self.followed = False
        """Whether the active appliance has sent the missing changes since this object was made."""
        self._introduction = introduction
        self._introduced = 0.0  # when, by the clock of the event loop
        self._obstacle = obstacle
        self._reported = ""  # the obstacle that the active appliance knows
        self._revised = revised
        self._refusal: asyncio.Future[str] | None = None
        self._messages = 0

    async def want_switchover(self) -> str:
        if self._link is None:
            raise ReplicationError("the active appliance is not connected")
        refusal: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._refusal, before = refusal, self._messages
        await self._link.send(SwitchoverWanted())
        try:
            async with asyncio.timeout(_REFUSAL_SECONDS):
                return await refusal
        except TimeoutError:
            if self._messages == before:  # it sends something every second
                raise ReplicationError("the active appliance does not answer") from None
            return ""

    def _refused(self, reason: str) -> None:
        if self._refusal is not None and not self._refusal.done():
            self._refusal.set_result(reason)

    async def follow(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        link: ReplicationLink[FromActive] = ReplicationLink(reader, writer, FromActive)
        self._introduced, self._reported = -_INTRODUCED_SECONDS, ""
        try:
            await link.send(self._replica.position)
            self._link = link
            await self._report_obstacle(link)
            while True:
                await self._introduce(link)
                message = await link.receive(_SILENCE_SECONDS)
                self._messages += 1
                if isinstance(message, Refused):
                    raise ReplicationError(f"the active appliance refuses: {message.reason}")
                if isinstance(message, SwitchoverRefused):
                    self._refused(message.reason)
                    continue
                try:
                    self._require_accepted(message)
                    await self._take(message)
                    if isinstance(message, Changes | SnapshotEnd):
                        self.followed = True
                        self.refusal.end()
                    if _has_revisions(message):
                        self._revised()
                except (ReplicationError, StoreError) as error:
                    self.refusal.note(str(error))
                    await link.send(reason_of(error))
                    raise
                await self._report_obstacle(link)  # before the active appliance counts this as stored
                await link.send(self._replica.position)
        finally:
            self._link = None
            self._refused("")  # the active appliance ends the link when it hands over
            await link.close()
            await asyncio.to_thread(self._replica.abandon_snapshot)

    async def _introduce(self, link: ReplicationLink[FromActive]) -> None:
        now, introduction = asyncio.get_running_loop().time(), self._introduction()
        if introduction is not None and now >= self._introduced + _INTRODUCED_SECONDS:
            self._introduced = now
            await link.send(introduction)

    async def _report_obstacle(self, link: ReplicationLink[FromActive]) -> None:
        """Report a new obstacle."""
        obstacle = self._obstacle()
        if obstacle != self._reported:
            self._reported = obstacle
            await link.send(obstacle_of(obstacle))

    async def _take(self, message: FromActive) -> None:
        """Store a message. A few small changes take less time than a thread, and an answer waits for them."""
        if isinstance(message, Changes) and _is_small(message):
            self._replica.take(message)
        else:
            await asyncio.to_thread(self._replica.take, message)

    def _require_accepted(self, message: FromActive) -> None:
        if isinstance(message, Changes | SnapshotBegin) and not self._accepts(message.epoch):
            raise ReplicationError(f"an appliance of epoch {message.epoch} is not accepted as the active one")


def _has_revisions(message: FromActive) -> bool:
    return isinstance(message, SnapshotEnd) or (
        isinstance(message, Changes) and any(map(_is_revision, message.changes))
    )


def _is_revision(change: Change) -> bool:
    if isinstance(change, Put) and change.table == "setting":
        return any(row[0] == SWITCHES for row in change.rows)
    return change.table in REVISION_TABLES


def _is_small(message: Changes) -> bool:
    values = (
        value for change in message.changes if isinstance(change, Put) for row in change.rows for value in row
    )
    return len(message.changes) <= _FEW and all(
        len(value) <= _SMALL for value in values if isinstance(value, bytes | str)
    )
