"""Send the changes of the active appliance's state to its standby, and wait until the standby has them.

A standby whose next change is no longer in memory gets a snapshot, as rows: a database file is input that it would
have to trust.

1. A change counts as acknowledged only if it was sent on this link, and the standby has reported it stored.
2. While the standby is away, at most `room` bytes of changes are kept; while it is connected, four times as many,
   so that the large values of a few hosts cost no snapshot. Changes never wait for the standby.
3. While the appliance answers alone, `until_acknowledged` does not wait. This ends once the standby has all changes.
4. A standby that comes back with less than it acknowledged no longer counts as having those changes.
"""

import asyncio
import contextlib
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeVar

import msgspec
import structlog

from appliance.base.counted import counted
from appliance.features.standby.replication_frames import (
    LARGEST_FRAME,
    EncodedChanges,
    FromStandby,
    Introduction,
    LastRefusal,
    ObstacleFound,
    Refused,
    ReplicationError,
    ReplicationLink,
    SnapshotBegin,
    SnapshotEnd,
    SnapshotRows,
    Stored,
    SwitchoverWanted,
    reason_of,
    refusal_of,
)
from appliance.store.changes import ROWS, Put
from appliance.store.writer_thread import Database, StoreError

_ROOM = 32 << 20
_LINKED = 4  # times the room, while a standby is connected: more than all large values that may be under way at once
_BATCH = 1 << 20  # bytes in one frame, but at least one change
_OVERHEAD = 64 << 10  # bytes of a frame besides the changes
_CHANGES_UNANSWERED = (
    2  # while two are under way, changes gather: the standby writes them to its disk together
)
_ROWS_UNANSWERED = 64
_HEARTBEAT_SECONDS = 1.0
_SILENCE_SECONDS = 30.0  # the standby writes a large snapshot to its disk in this time

T = TypeVar("T")

_log = structlog.get_logger()


class ReplicationLag(NamedTuple):
    """How far the standby is behind."""

    connected: bool
    changes: int
    bytes: int
    waiting_since: float | None
    """The time of the event loop at which the oldest waiting answer began to wait."""
    reason: str
    obstacle: str = ""
    """Why the connected standby could not serve after a takeover."""
    refusal: str = ""

    @property
    def caught_up(self) -> bool:
        return self.connected and not self.changes


class ReplicationSender:
    """Sends the changes of `database` to the standby.

    Create it in the event loop, before the first change that the standby needs.
    """

    def __init__(
        self,
        database: Database,
        epoch: Callable[[], int],
        *,
        room: int = _ROOM,
        switchover_wanted: Callable[[], None] = lambda: None,
    ) -> None:
        self._database = database
        self._epoch = epoch
        self._switchover_wanted = switchover_wanted
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()
        self._room = room
        self._feed = database.follow(self._notice, room)
        self._acknowledged = 0
        self._sent = self._most_sent = 0  # on this link, on all links
        self._unanswered = 0
        self._answered = asyncio.Event()
        self._reason = self._obstacle = ""
        self._refusal = LastRefusal()
        self.link: asyncio.Task[None] | None = None
        self._open: ReplicationLink[FromStandby] | None = None
        self._waiting: dict[asyncio.Future[None], tuple[int, float]] = {}
        self.alone = False
        self._introduced: Callable[[Introduction], None] = lambda _introduction: None

    async def until_acknowledged(self, number: int) -> None:
        if self.alone:
            return
        if number > self._acknowledged and not self.alone:
            waiter = self._loop.create_future()
            self._waiting[waiter] = (number, self._loop.time())
            try:
                await waiter
            finally:
                del self._waiting[waiter]

    def on_introduction(self, introduced: Callable[[Introduction], None]) -> None:
        self._introduced = introduced

    async def refuse_switchover(self, reason: str) -> None:
        if self._open is not None:
            with contextlib.suppress(ReplicationError):
                await self._open.send(refusal_of(reason))

    def answer_alone(self) -> None:
        self.alone = True
        for waiter in self._waiting:
            if not waiter.done():
                waiter.set_result(None)

    def lag(self) -> ReplicationLag:
        return ReplicationLag(
            self.link is not None,
            self._database.number - self._acknowledged,
            self._feed.size,
            min((since for _number, since in self._waiting.values()), default=None),
            self._reason,
            self._obstacle if self.link is not None else "",
            self._refusal.reason,
        )

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        link: ReplicationLink[FromStandby] = ReplicationLink(reader, writer, FromStandby)
        try:
            while (earlier := self.link) is not None:
                earlier.cancel()
                await asyncio.wait([earlier])
                if self.link is earlier:
                    self.link = None
            own = self.link = self._loop.create_task(self._serve(link))
            self._feed.keep(_LINKED * self._room)
            try:
                await asyncio.wait([own])
            finally:
                own.cancel()
                if self.link is own:
                    self.link = None
                    self._feed.keep(self._room)
            if own.cancelled():
                raise ReplicationError(
                    "the standby opened another link, or this appliance is no longer active"
                )
            try:
                own.result()
            except (ReplicationError, StoreError) as error:
                self._reason = str(error)
                raise ReplicationError(self._reason) from error
        finally:
            await link.close()

    def close(self) -> None:
        self._database.unfollow(self._feed)
        for waiter in self._waiting:
            if not waiter.done():
                waiter.set_exception(ReplicationError("this appliance is no longer active"))
        if self.link is not None:
            self.link.cancel()

    def _notice(self) -> None:
        if not self._changed.is_set():  # `_send` clears it before it looks for the last changes
            with contextlib.suppress(RuntimeError):  # the loop has ended, so no link is open
                self._loop.call_soon_threadsafe(self._changed.set)

    async def _serve(self, link: ReplicationLink[FromStandby]) -> None:
        begin = await link.receive(_SILENCE_SECONDS)
        if not isinstance(begin, Stored):
            reason = begin.reason if isinstance(begin, Refused) else "it did not send its position first"
            raise ReplicationError(f"the standby refuses: {reason}")
        if begin.epoch > self._epoch():
            error = ReplicationError(
                f"the standby has seen epoch {begin.epoch}, and this appliance is active in {self._epoch()}"
            )
            await link.send(reason_of(error))
            raise error
        known = begin.history == self._database.history and begin.number <= self._most_sent
        position = begin.number if known and self._feed.after(begin.number, 0) is not None else None
        if known and begin.number < self._acknowledged:
            _log.error(
                "the standby has lost changes that it acknowledged",
                acknowledged=self._acknowledged,
                stored=begin.number,
            )
        self._acknowledged = self._sent = self._unanswered = 0
        self._obstacle = ""
        if position is not None:
            self._sent = position
            self.take(begin)
        self._open = link
        ends = [
            self._loop.create_task(self._receive(link)),
            self._loop.create_task(self._send(link, position)),
        ]
        try:
            ended, _ = await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            self._open = None
            for task in ends:
                task.cancel()
            await asyncio.gather(*ends, return_exceptions=True)

    async def _receive(self, link: ReplicationLink[FromStandby]) -> None:
        while True:
            message = await link.receive(_SILENCE_SECONDS)
            if isinstance(message, Refused):
                self._refusal.note(message.reason)
                raise ReplicationError(f"the standby refuses: {message.reason}")
            if isinstance(message, SwitchoverWanted):
                self._switchover_wanted()
                continue
            if isinstance(message, Introduction):
                self._introduced(message)
                continue
            if isinstance(message, ObstacleFound):
                self._obstacle = message.reason
                continue
            self._unanswered -= 1
            self._answered.set()
            if message.history == self._database.history:
                before = self._acknowledged
                self.take(message)
                if message.number > before or message.number == self._database.number:
                    self._refusal.end()

    def take(self, stored: Stored) -> None:
        if stored.number > self._sent:
            raise ReplicationError(
                f"the standby acknowledged change {stored.number}, but was sent only {counted(self._sent, 'change')}"
            )
        if stored.number < self._acknowledged:
            raise ReplicationError(
                f"the standby acknowledged change {stored.number} after {self._acknowledged}"
            )
        self._acknowledged = stored.number
        self._feed.release(stored.number)
        self.alone = self.alone and stored.number < self._database.number
        for waiter, (number, _since) in self._waiting.items():
            if number <= stored.number and not waiter.done():
                waiter.set_result(None)

    async def _send(self, link: ReplicationLink[FromStandby], position: int | None) -> None:
        while True:
            await self._free_to_send(_CHANGES_UNANSWERED)
            changes = None if position is None else self._feed.after(position, _BATCH)
            if (
                position is None
                or changes is None
                or sum(len(change.body) for change in changes) > LARGEST_FRAME - _OVERHEAD
            ):  # a snapshot has only the latest values, so a value that was too large may be gone
                position = await self._send_snapshot(link)
                continue
            bodies = [msgspec.Raw(change.body) for change in changes]
            self.note_sent(position + len(changes))
            await self._post(
                link, EncodedChanges(self._epoch(), self._database.history, position + 1, bodies)
            )
            position = self._sent
            if self._feed.after(position, 0) == []:
                self._changed.clear()
                if self._feed.after(position, 0) == []:
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(_HEARTBEAT_SECONDS):
                            await self._changed.wait()

    async def _send_snapshot(self, link: ReplicationLink[FromStandby]) -> int:
        await self._database.until_settled()
        copy = await _in_thread(self._database.copy)
        with contextlib.closing(copy):
            found = copy.execute("SELECT number FROM journal").fetchone()
            number = found[0] if found else 0
            self.note_sent(number)
            await self._post(link, SnapshotBegin(self._epoch(), self._database.history, number))
            rows = 0
            puts = _rows_of(copy, self._database.tables)
            while (put := await _in_thread(lambda: next(puts, None))) is not None:
                await self._free_to_send(_ROWS_UNANSWERED)
                await self._post(link, SnapshotRows([put]))
                rows += len(put.rows)
            await self._post(link, SnapshotEnd(rows))
        return number

    async def _free_to_send(self, most: int) -> None:
        while self._unanswered >= most:
            self._answered.clear()
            await self._answered.wait()

    async def _post(self, link: ReplicationLink[FromStandby], message: msgspec.Struct) -> None:
        self._unanswered += 1
        await link.send(message)

    def note_sent(self, number: int) -> None:
        self._sent = number
        self._most_sent = max(self._most_sent, number)


async def _in_thread(function: Callable[[], T]) -> T:
    """Call a function in a thread. Wait for its end even if cancelled: the caller then closes its connection."""
    task = asyncio.ensure_future(asyncio.to_thread(function))
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.wait([task])
        raise


def _rows_of(copy: sqlite3.Connection, tables: Iterable[str]) -> Iterator[Put]:
    for table in tables:
        rows: list[tuple[str | int | float | bytes | None, ...]] = []
        size = 0
        for row in copy.execute(f"SELECT * FROM {table}"):  # noqa: S608  a table of the schema
            size_of_row = sum(len(value) for value in row if isinstance(value, str | bytes))
            if rows and (len(rows) == ROWS or size + size_of_row > _BATCH):
                yield Put(table, rows)
                rows, size = [], 0
            rows.append(row)
            size += size_of_row
        if rows:
            yield Put(table, rows)
