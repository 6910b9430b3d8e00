"""Replicate the state of the active one of two appliances, and hold answers back until the standby has stored it.

1. An answer waits until the standby has stored all changes made before it, or until the witness has removed the
   standby from the in-sync set.
2. Without a valid lease nothing is answered.
3. The lease is given up only after the standby, which is in sync, has stored every change.
4. Before a switchover pauses anything, the standby has stored as much as the switchover will write.
"""

import asyncio
import contextlib
import os
import socket
import ssl
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import msgspec
import structlog

from appliance.base import clock
from appliance.base.background import run_always
from appliance.channel.channel import Channel
from appliance.configuration.settings import Settings
from appliance.features.standby import lease_link
from appliance.features.standby.answers import OtherAppliance, StandbyState, WitnessSeen
from appliance.features.standby.lease_client import HandOverError, LeaseClient
from appliance.features.standby.link_certificates import replication_context
from appliance.features.standby.membership import Membership
from appliance.features.standby.replication_frames import Introduction, ReplicationError
from appliance.features.standby.replication_receiver import ReplicationReceiver
from appliance.features.standby.replication_sender import ReplicationSender
from appliance.features.standby.summary import CHECKS, takeover_obstacles
from appliance.features.standby.tunnels import StandbyTunnels
from appliance.features.standby.witness.protocol import EXPIRY
from appliance.store.writer_thread import Database, StoreError

# Carry the replication over TLS 1.3: the active appliance listens, the standby connects.

_HANDSHAKE_SECONDS = 5.0
_PAUSE_SECONDS = 1.0
_MAX_CONNECTIONS = 8  # one is in use; others are in their handshake, or replace it


class _Server(Protocol):
    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None: ...


class ReplicationListener:
    """Accepts the other appliance's connections."""

    def __init__(self, server: _Server, context: ssl.SSLContext) -> None:
        self._server = server
        self._context = context
        self._connections: set[asyncio.Task[None]] = set()

    async def run(self, listening: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        listening.setblocking(False)
        try:
            while True:
                try:
                    connection, _address = await loop.sock_accept(listening)
                except OSError as error:  # such as too many open files
                    _log.warning("a connection for replication was not accepted", error=str(error))
                    await asyncio.sleep(_PAUSE_SECONDS)
                    continue
                if len(self._connections) >= _MAX_CONNECTIONS:
                    connection.close()
                    continue
                task = loop.create_task(self._serve(connection))
                self._connections.add(task)
                task.add_done_callback(self._connections.discard)
        finally:
            for task in self._connections:
                task.cancel()
            await asyncio.gather(*self._connections, return_exceptions=True)

    async def _serve(self, connection: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader()
        protocol = asyncio.StreamReaderProtocol(reader)
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # asyncio omits it here
            transport, _ = await loop.connect_accepted_socket(
                lambda: protocol, connection, ssl=self._context, ssl_handshake_timeout=_HANDSHAKE_SECONDS
            )
        except OSError as error:
            connection.close()
            _log.warning("a connection for replication was refused", error=str(error))
            return
        writer = asyncio.StreamWriter(transport, protocol, reader, loop)
        try:
            await self._server.serve(reader, writer)
        except ReplicationError as error:
            _log.warning("the replication to the standby ended", reason=str(error))


async def follow_at(address: str, port: int, context: ssl.SSLContext, receiver: ReplicationReceiver) -> None:
    try:
        async with asyncio.timeout(2 * _HANDSHAKE_SECONDS):
            reader, writer = await asyncio.open_connection(
                address, port, ssl=context, ssl_handshake_timeout=_HANDSHAKE_SECONDS
            )
    except (OSError, TimeoutError) as error:
        raise ReplicationError(f"{address}:{port} does not answer: {error}") from error
    await receiver.follow(reader, writer)


_GAP_SECONDS = 0.9  # without an answer of the witness; less than the confidence of a follower
_ADMITTED_SECONDS = 2.0  # after the next answer, until all followers admit this appliance again


class RobotAdmission:
    """Derives from the witness's answers (times of CLOCK_BOOTTIME) whether the robot may have shut this appliance
    out.
    """

    def __init__(self) -> None:
        self._answered = self._admitted = clock.since_boot()
        self._gap_ended: Callable[[], None] = lambda: None

    def on_end_of_gap(self, gap_ended: Callable[[], None]) -> None:
        self._gap_ended = gap_ended

    def note_answer(self, at: float) -> None:
        gap = at - self._answered > _GAP_SECONDS
        self._answered = max(self._answered, at)
        if gap:
            self._admitted = at
            self._gap_ended()

    def in_doubt(self) -> bool:
        now = clock.since_boot()
        return now - self._answered > _GAP_SECONDS or now - self._admitted < _ADMITTED_SECONDS


_REPORT_SECONDS = 0.1
_SYNC_SECONDS = 0.1
_BACKLOG = 8
_REHEARSAL_SECONDS = EXPIRY
_CHECK_SECONDS = 2.0  # a policy takes less, monitors can take more
_SETTLE_SECONDS = 1.0  # topics are paused
_LOOK_SECONDS = 0.01
_ANSWER_SECONDS = 5.0
_LEAST_BYTES_A_SECOND = 20 << 20  # that a standby stores
_PORT_SECONDS = 1.0  # until the port of the replication is tried again

_log = structlog.get_logger()


class Pair(NamedTuple):
    """The lease and the replication of an active appliance in its epoch."""

    membership: Membership
    lease: LeaseClient
    epoch: int
    api: Channel | None
    taken_over: bool
    """Whether this process stood by before, and then opened the links `api` and `tunnels`."""
    tunnels: StandbyTunnels
    away_seconds: float | None = None
    """At the takeover, the seconds since this process last followed the other appliance, or None if it never did."""
    copy_age: float | None = None
    """The age of the copies of monitors' state at the takeover."""


def state_of(
    membership: Membership,
    lease: lease_link.LeaseState | None,
    *,
    role: Literal["active", "standby"],
    since: float,
    other: OtherAppliance,
    obstacle: str,
) -> StandbyState:
    now = clock.since_boot()
    state = StandbyState(
        name=membership.name,
        address=membership.address,
        role=role,
        epoch=lease.epoch if lease is not None else 0,
        since=since,
        fixed=membership.fixed,
        answers_alone=lease is not None and lease.alone,
        other=other,
        witness=WitnessSeen(
            address=membership.witness,
            answered_seconds=None
            if lease is None or lease.answered is None
            else round(now - lease.answered, 3),
            holder=lease.holder if lease is not None else "",
            refusal=lease.refusal if lease is not None else "",
            trouble=lease.trouble if lease is not None else "",
            follower_trouble=lease.follower_trouble if lease is not None else "",
        ),
        obstacle=obstacle,
        troubles=[],
        not_serving=lease.fault if lease is not None else "",
    )
    obstacles = takeover_obstacles(state, lease.takeover_obstacle if lease is not None else "")
    return msgspec.structs.replace(state, troubles=obstacles)


def host_endpoint(settings: Settings, membership: Membership) -> str:
    return settings.ipsec.endpoint or membership.address


class _ReplicationPort:
    """The port to which the standby connects; `trouble` is the reason why it cannot."""

    def __init__(self, number: int, listener: ReplicationListener) -> None:
        self._number = number
        self._listener = listener
        self.trouble = ""

    async def run(self) -> None:
        with await self._listening() as listening:
            await self._listener.run(listening)

    async def _listening(self) -> socket.socket:
        address = ("", self._number)
        while True:
            try:
                made = socket.create_server(address, backlog=_BACKLOG)
            except OSError as error:
                if not self.trouble:
                    reason = os.strerror(error.errno or 0)
                    self.trouble = f"the standby cannot connect to port {address[1]}: {reason}"
                    _log.error("the replication is not served", reason=self.trouble)
                await asyncio.sleep(_PORT_SECONDS)
            else:
                self.trouble = ""
                return made


class Replication:
    """The replication of an active appliance. Create it before the first change that the standby needs."""

    def __init__(
        self,
        membership: Membership,
        lease: LeaseClient,
        database: Database,
        epoch: int,
        *,
        taken_over: bool,
        folder: Path,
    ) -> None:
        self._membership = membership
        self._lease = lease
        self._database = database
        self._since = clock.Began()
        self.switchover_wanted = asyncio.Event()
        self.sender = ReplicationSender(database, lambda: epoch, switchover_wanted=self.switchover_wanted.set)
        context = replication_context(membership, folder, server=True)
        self._port = _ReplicationPort(membership.port, ReplicationListener(self.sender, context))
        self._permission = 0
        self._trouble_since: float | None = None
        self.admission = RobotAdmission()
        self._taken_over = taken_over
        self._absent = False  # whether the first answers would wait for the other appliance in vain
        self._tasks: set[asyncio.Task[None]] = set()
        self._reported: lease_link.ReplicationReported | None = None
        lease.listen(self._lease_changed)
        self.report()

    def on_introduction(self, introduced: Callable[[Introduction], Coroutine[object, object, None]]) -> None:
        def start(introduction: Introduction) -> None:
            task = asyncio.get_running_loop().create_task(introduced(introduction))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

        self.sender.on_introduction(start)

    async def run(self) -> None:
        self.begin()
        loop = asyncio.get_running_loop()
        tasks = [
            loop.create_task(run_always("the report of the replication", self._report_always)),
            loop.create_task(run_always("the copy on this disk", self._sync_always)),
        ]
        try:
            await self._port.run()
        finally:
            for task in tasks:
                task.cancel()

    def begin(self) -> None:
        """Serve the standby. After a takeover, request the removal of the earlier active appliance.

        Otherwise the first answers would wait for that appliance in vain. Before this call, it may take the lease
        back.
        """
        self._lease.present()
        self._absent, self._taken_over = self._taken_over, False
        self.report()

    def close(self) -> None:
        """Stop. A change that is not answered yet gets no answer."""
        self.sender.close()

    async def until_stored(self) -> None:
        try:
            await self.sender.until_acknowledged(self._database.number)
        except ReplicationError as error:
            _log.warning("a change is not answered", reason=str(error))
            await asyncio.get_running_loop().create_future()  # the supervisor ends this process
        await self._lease.until_active()

    def state(self) -> StandbyState:
        lag, lease, now = self.sender.lag(), self._lease.state, asyncio.get_running_loop().time()
        waiting, trouble = lag.waiting_since, self._trouble_since
        witnessed = lease.other_witnessed if lease is not None else None
        other = OtherAppliance(
            name=self._membership.other,
            address=self._membership.other_address,
            connected=self._connected(),
            in_sync=self._in_sync(),
            behind_changes=lag.changes,
            behind_bytes=lag.bytes,
            waiting_seconds=None if waiting is None else round(now - waiting, 3),
            reason=""
            if self._connected()
            else self._port.trouble or lag.refusal or lag.reason or "it does not answer",
            trouble_seconds=None if trouble is None else round(now - trouble, 3),
            witness_seconds=None if witnessed is None else round(clock.since_boot() - witnessed, 3),
            refusal=lag.refusal,
        )
        return state_of(
            self._membership,
            lease,
            role="active",
            since=self._since.date(),
            other=other,
            obstacle=lag.obstacle,
        )

    def is_followed(self) -> bool:
        return self.sender.lag().connected

    def _connected(self) -> bool:
        lease, lag = self._lease.state, self.sender.lag()
        heard = lease.heard if lease is not None else None
        answers = heard is not None and clock.since_boot() - heard < _ANSWER_SECONDS
        return lag.connected and not lag.refusal and answers

    async def require_ready(self, rehearse: Callable[[], Awaitable[None]]) -> None:
        """Raise `HandOverError` unless the standby can take over; `rehearse` writes as much as the switchover.

        A check of the last change may end soon. The witness must answer the standby after that and after the order:
        its cable may just have been unplugged, and the same answer says whether it may be given the lease.
        """
        if not self._is_checking():
            self._require_no_trouble()
        await self._settle(_REHEARSAL_SECONDS, rehearse)
        with contextlib.suppress(TimeoutError):  # then it is the trouble
            async with asyncio.timeout(_CHECK_SECONDS):
                while self._is_checking():
                    await asyncio.sleep(_LOOK_SECONDS)
        heard = await self._lease.standby_hears_witness()
        self._require_no_trouble()
        if not heard:
            other = self._membership.other
            raise HandOverError(
                f"the witness on the robot does not answer {other}; check the network between {other} and the robot"
            )

    def _is_checking(self) -> bool:
        return self.sender.lag().obstacle in CHECKS

    def _require_no_trouble(self) -> None:
        if troubles := self.state().troubles or [*filter(None, [self.sender.lag().obstacle])]:
            raise HandOverError(troubles[0])

    async def hand_over(self) -> None:
        await self._settle(_SETTLE_SECONDS)
        self._require_no_trouble()
        await self._lease.hand_over()

    async def _settle(self, seconds: float, write: Callable[[], Awaitable[None]] | None = None) -> None:
        """Wait until the standby has stored all changes, and first those of `write`.

        Nodes wait for none of these changes, so a slow standby stays in the in-sync set.
        """
        try:
            async with asyncio.timeout(seconds):
                if write is not None:
                    await write()
                number = self._database.number
                while self._database.number - self.sender.lag().changes < number:
                    await asyncio.sleep(_LOOK_SECONDS)
        except TimeoutError:
            raise HandOverError(
                f"{self._membership.other} has not stored the last changes after {seconds:g} s, so topics would pause"
                f" for longer; check the network between both, and the disk of {self._membership.other}"
            ) from None

    def _lease_changed(self, state: lease_link.LeaseState) -> None:
        if state.answered is not None and not state.refusal:  # it may admit no appliance
            self.admission.note_answer(state.answered)
        if state.alone and state.permission > self._permission:
            self._permission = state.permission
            self.sender.answer_alone()
            self.report()

    def _in_sync(self) -> bool:
        lease = self._lease.state
        return lease is not None and lease.in_sync and not lease.alone

    async def _report_always(self) -> None:
        while True:
            if self._in_sync() and self._connected() and not self._is_checking():
                self._trouble_since = None
            elif self._trouble_since is None:
                self._trouble_since = asyncio.get_running_loop().time()
            self.report()
            await asyncio.sleep(_REPORT_SECONDS)

    async def _sync_always(self) -> None:
        synced = 0
        while True:
            number = self._database.number
            if number != synced:
                with contextlib.suppress(StoreError):  # reported by the store, which tries again
                    await self._database.until_settled()
                    synced = number
            await asyncio.sleep(_SYNC_SECONDS)

    def report(self) -> None:
        lag = self.sender.lag()
        self._absent = self._absent and not (lag.connected or self.sender.alone)
        waiting = lag.waiting_since
        if self._absent:
            waiting = 0.0
        elif waiting is not None:
            # A standby that stores a large value is not away: it gets the time that the bytes need.
            waiting = clock.since_boot() - (asyncio.get_running_loop().time() - waiting)
            waiting += lag.bytes / _LEAST_BYTES_A_SECOND
        report = lease_link.ReplicationReported(
            permission=self._permission,
            caught_up=lag.caught_up and not self.sender.alone,
            waiting_since=waiting,
        )
        if report != self._reported:
            self._reported = report
            self._lease.send(report)
