"""Stand by: follow the active appliance until this one is activated. Only the file of the replica changes."""

import asyncio
import contextlib
import math
import socket
import sqlite3
import ssl
from collections.abc import Awaitable, Callable, Mapping
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

import structlog

from appliance.base import clock
from appliance.base.background import run_always
from appliance.channel import messages
from appliance.channel.admin import AdminAnswer, encode
from appliance.channel.channel import Channel, ChannelFullError
from appliance.channel.link import Link
from appliance.channel.messages import Message
from appliance.channel.messages.api import (
    ConnectionAnswered,
    ConnectionPassed,
    RequestAnswered,
    RequestMade,
    RestServed,
    TokenKept,
    TokensStated,
)
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import STATE_ERRORS
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.control.operators.admin_socket import AdminServer, RequestHandler
from appliance.control.operators.token_orders import TOKENS, kept_by_api
from appliance.control.rest.rest_proof import RequestAuthenticator, UnprovenError
from appliance.control.start_rehearsal import SERVING_ROOM, StartRehearsal, lacking_room
from appliance.features.standby.answers import OtherAppliance, StandbyState
from appliance.features.standby.inheritance import CopyAge
from appliance.features.standby.lease_client import HandOverError, LeaseClient
from appliance.features.standby.link_certificates import replication_context
from appliance.features.standby.membership import Membership
from appliance.features.standby.orders import StandbyAdministration
from appliance.features.standby.replica import Replica
from appliance.features.standby.replica_sync import INCOMPLETE, ReplicaSync, StateComparison, is_recovered
from appliance.features.standby.replication import (
    Pair,
    ReplicationListener,
    follow_at,
    host_endpoint,
    state_of,
)
from appliance.features.standby.replication_frames import ReplicationError
from appliance.features.standby.replication_receiver import ReplicationReceiver
from appliance.features.standby.summary import CHECKING, CHECKS, UNCHECKED
from appliance.features.standby.tunnels import StandbyTunnels
from appliance.signing.request_signing import TokenKeys
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.specifications.rollout import Parts
from appliance.specifications.specification_revisions import Check
from appliance.store.access_tokens import TokenRow
from appliance.store.ends import replicated_ends
from appliance.store.state_file import SCHEMA
from appliance.store.writer_thread import StoreError

# Check on a standby that control could start if this appliance took over now, and would not give the lease away.
#
# The check also writes to the disk of the state and to the audit log, and compiles the specifications, so that a
# takeover need not. It is repeated, because the appliance's own files, disk and ports may change. While it fails, this
# appliance does not claim the lease, but still follows the active one and stays in the in-sync set. With little room it
# claims a lease that the active one has lost, but is given none: as a standby it writes less, so both could pass the
# lease to and fro. The same holds from a change of the policy or the specifications until the check ends: a takeover
# compiles what has changed, which can take longer than a new active appliance may need until it serves.

_CHECK_AGAIN_SECONDS = 15.0


class TakeoverCheck:
    """The check. `obstacle` prevents each takeover, `scarce` those from an active appliance that is not away."""

    def __init__(
        self,
        settings: Settings,
        membership: Membership,
        compile_specifications: Check,
        parts: Parts,
        *,
        again: float = _CHECK_AGAIN_SECONDS,
    ) -> None:
        self._membership = membership
        self._rehearsal = StartRehearsal(settings, compile_specifications, parts, robot=membership.witness)
        self._again = again
        self.obstacle = UNCHECKED
        self.scarce = ""
        self._news = asyncio.Event()

    def note_news(self) -> None:
        """Check again, because the policy or the specifications of the active appliance have changed."""
        self.scarce = self.scarce or CHECKING
        self._news.set()

    async def run(self, changed: Callable[[], None]) -> None:
        while True:
            self._news.clear()
            obstacle = await self._find_obstacle()
            scarce = "" if obstacle else self._find_scarce() or (CHECKING if self._news.is_set() else "")
            if self.scarce == CHECKING or (obstacle, bool(scarce)) != (self.obstacle, bool(self.scarce)):
                self.scarce = scarce
                if self.obstacle not in ("", UNCHECKED):
                    _log.info("the reason why this appliance cannot take over is gone", reason=self.obstacle)
                self.obstacle = obstacle
                changed()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._again):
                    await self._news.wait()

    def _find_scarce(self) -> str:
        short, other = lacking_room(self._rehearsal.folder, SERVING_ROOM), self._membership.other
        return short and f"{short}; until then it takes over only while {other} is away"

    async def _find_obstacle(self) -> str:
        try:
            await self._load()
        except STATE_ERRORS as error:
            reason, *more = str(error).splitlines() or [repr(error)]
        except Exception as error:  # noqa: BLE001  whatever it is, it would also end the start
            what = f"the state of the active appliance is not understood ({error!r})"
            reason, more = f"{what}; update this appliance to the same version", []
        else:
            return ""
        if reason != self.obstacle:
            _log.error("this appliance cannot take over", reason=reason, more=more)
        return reason

    async def _load(self) -> None:
        await self._rehearsal.run()
        if self.obstacle != "":  # the membership stays the same, and each call writes files
            replication_context(self._membership, self._rehearsal.folder, server=True)


# Serve the api of a standby: it knows the replicated tokens, and gets the same answers as the admin socket.

_MAX_WAITING = 64
_READ_SECONDS = 2.0
_TAKING_OVER = "the appliance is taking over: try again"
_NO_DOORS = "this appliance is the standby: open the door at the active appliance (rosrv standby status)"


class ReplicatedTokens:
    """The tokens in the replica, read again from time to time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: dict[str, TokenRow] | None = None
        self._ends: dict[str, tuple[int, float]] = {}  # by token: its stored end, and seconds since the boot
        self._stated: object = None
        self.blocked: list[str] = []
        """The addresses that operators block."""

    @property
    def known(self) -> bool:
        return self._rows is not None

    def read(self) -> bool:
        """Read the replica; return whether the tokens or blocks for the api have changed."""
        with suppress(sqlite3.Error):  # no state yet
            with closing(sqlite3.connect(f"file:{self._path}?mode=ro", uri=True)) as connection:
                connection.execute("BEGIN")  # one snapshot: keys and tokens of the same time
                keys = {row[0]: TokenKeys(*row[1:]) for row in connection.execute("SELECT * FROM token_keys")}
                found = connection.execute("SELECT * FROM token").fetchall()
                self.blocked = [row[0] for row in connection.execute("SELECT address FROM host_block")]
                left = replicated_ends(connection, TOKENS)
            self._rows = {row[0]: TokenRow._make((*row, keys.get(row[0]))) for row in found}
            self._keep_ends(left)
            before, self._stated = self._stated, ([*map(self.usable_row, self._rows)], self.blocked)
            return before != self._stated
        return False

    def _keep_ends(self, left: Mapping[str, tuple[int, float]]) -> None:
        """Keep the earliest known time of each end: an older reading of the clocks gives a token no more time."""
        ends, now = {}, clock.since_boot()
        for name, (at, seconds) in left.items():
            earlier = self._ends.get(name)
            same = earlier is not None and earlier[0] == at
            ends[name] = at, min(now + seconds, earlier[1] if earlier is not None and same else math.inf)
        self._ends = ends

    def usable_row(self, token_id: str) -> TokenRow | None:
        row, end = (self._rows or {}).get(token_id), self._ends.get(token_id)
        lasts = row is not None and row.revoked is None and end is not None and clock.since_boot() < end[1]
        return row if lasts else None

    def usable(self) -> list[TokenKept]:
        now = clock.wall() - clock.since_boot()
        rows = filter(None, map(self.usable_row, self._rows or {}))
        return [kept_by_api(row._replace(expires=now + self._ends[row.id][1])) for row in rows]


class PassiveRest:
    """The link to the api of a standby, and the pin of its key."""

    def __init__(self, administration: RequestHandler, tokens: ReplicatedTokens) -> None:
        self._administration = administration
        self._tokens = tokens
        self._askers = RequestAuthenticator(tokens, require_proof=False)
        self._link = Link(self._on_message)
        self.pin = ""
        self._serving: dict[int, asyncio.Task[None]] = {}

    def attach(self, channel: Channel) -> None:
        """Until the tokens can be read, the api answers 503: the appliance is starting."""
        self._link.attach(channel)
        self._tokens.read()
        if self._tokens.known:  # with an empty list, the api would tell users that their tokens are revoked
            self._state_tokens()

    def release(self) -> Channel | None:
        for number, task in self._serving.items():
            task.cancel()
            self._answer(number, AdminAnswer(False, error=_TAKING_OVER, trouble="busy"))
        return self._link.release()

    async def run(self) -> None:
        while True:
            if await asyncio.to_thread(self._tokens.read):
                self._state_tokens()
            await asyncio.sleep(_READ_SECONDS)

    def _on_message(self, message: object) -> None:
        if isinstance(message, RestServed):
            self.pin = message.pin
        if isinstance(message, ConnectionPassed):
            self._send(ConnectionAnswered(message.number, 503, _NO_DOORS))
        if not isinstance(message, RequestMade):
            return  # the standby records no calls: the active appliance records its own
        if len(self._serving) >= _MAX_WAITING:
            text = "too many requests wait for the appliance: try again"
            self._answer(message.number, AdminAnswer(False, error=text, trouble="busy"))
            return
        task = asyncio.get_running_loop().create_task(self._serve(message))
        self._serving[message.number] = task
        task.add_done_callback(lambda _task: self._serving.pop(message.number, None))

    async def _serve(self, made: RequestMade) -> None:
        try:
            who = await self._askers.asker(made)
        except UnprovenError as error:
            self._answer(made.number, AdminAnswer(False, error=str(error), trouble="forbidden"))
            return
        self._answer(made.number, await self._administration.carry_out(made.request, who=who))

    def _answer(self, number: int, answer: AdminAnswer[object]) -> None:
        self._send(RequestAnswered(number, encode(answer)))

    def _state_tokens(self) -> None:
        self._send(TokensStated(self._tokens.usable(), self._tokens.blocked))

    def _send(self, message: Message) -> None:
        try:
            self._link.send(message)
        except ChannelFullError:
            self._link.close()
            _log.error("the api does not read its answers: its link is closed")


_AGAIN_SECONDS = 0.3
_MAX_AGAIN_SECONDS = 5.0  # after refusals: each begins with the whole state
_ADMIN = "admin"

_log = structlog.get_logger()


class PassiveControl:
    def __init__(
        self,
        settings: Settings,
        membership: Membership,
        lifeline: ControlLifeline,
        lease: LeaseClient,
        compiler: SpecificationCompiler,
    ) -> None:
        self._settings = settings
        self._membership = membership
        self._lifeline = lifeline
        self._lease = lease
        self._folder = settings.state / "control"
        self._since = clock.Began()
        self._replica = Replica(
            self._folder / "state.db",
            SCHEMA,
            failed=lambda reason: _log.error("state is not written", reason=reason),
        )
        self.tunnels = StandbyTunnels()
        endpoint = host_endpoint(settings, membership)
        self._replica_sync = ReplicaSync(self._replica, self._folder)
        self._comparison = StateComparison(lambda: self._replica.position)
        self._check = TakeoverCheck(settings, membership, compiler.check_at_start, compiler.parts)
        self._complete = False  # whether no acknowledged change is missing
        self._receiver = ReplicationReceiver(
            self._replica,
            self._accepts,
            lambda: self.tunnels.introduction(endpoint, self._rest.pin),
            lambda: self.obstacle,
            self._revised,
        )
        self.copies = CopyAge(self._replica.setting)
        self._epoch = 0
        self._connected = False
        self._away_since = clock.now()
        self._reason = self._unlistened = ""
        self._rest = PassiveRest(
            StandbyAdministration(self, orders=False), ReplicatedTokens(self._folder / "state.db")
        )
        self.api: Channel | None = None  # the link to the api, after `run`

    async def run(self, until: asyncio.Event) -> None:
        loop = asyncio.get_running_loop()

        def begin(what: str, work: Callable[[], Awaitable[None]]) -> asyncio.Task[None]:
            return loop.create_task(run_always(what, work))

        tasks = [
            begin("the link to the active appliance", self._follow),
            begin("the preparation of tunnels", self._prepare_tunnels),
        ]
        server = await AdminServer(StandbyAdministration(self, orders=True)).start(
            self._lifeline.sockets[_ADMIN].dup()
        )
        stating = begin("the tokens of REST", self._rest.run)
        self._lifeline.hear(self._heard)
        self._lifeline.hear_tunnels(self.tunnels.answered)
        self._lifeline.say(messages.Ready({"stands_by": True}))
        comparing = begin("the comparison with the other appliance", self._compare)
        tasks += [
            comparing,
            begin("the copy of the state", partial(self._sync, comparing.cancel)),
            begin("the age of the copies of monitors", self.copies.run),
            begin("the check of a takeover", partial(self._check.run, self._state_presence)),
        ]
        try:
            await until.wait()
        finally:
            server.close()
            self._lifeline.pause()
            self.api = self._rest.release()
            self.tunnels.pin = self._rest.pin
            for task in (*tasks, stating):
                task.cancel()
            await asyncio.wait([*tasks, stating])
            await asyncio.to_thread(self._replica.close)

    async def _sync(self, completed: Callable[[], object]) -> None:
        def complete() -> None:
            completed()
            self._complete = True
            self._state_presence()

        reason = ""
        while True:
            try:
                await self._replica_sync.run(self._is_recovered, complete)
            except (StoreError, OSError) as error:
                self._state_presence()  # `complete` ends this
                if reason != str(error):
                    reason = str(error)
                    _log.error("the copy of the state is not on the disk", reason=reason)
                await asyncio.sleep(_AGAIN_SECONDS)

    def _revised(self) -> None:
        self._check.note_news()
        self._state_presence()

    @property
    def obstacle(self) -> str:
        """Why this appliance could not take over, although it may follow."""
        return self._unfit or self._check.scarce

    @property
    def _unfit(self) -> str:
        return self._check.obstacle or self._replica.unsynced or ("" if self._complete else INCOMPLETE)

    @property
    def away_seconds(self) -> float | None:
        if not self._receiver.followed:
            return None
        return 0.0 if self._connected else clock.now() - self._away_since

    @property
    def copy_age(self) -> float | None:
        return self.copies.at(clock.now() if self._connected else self._away_since)

    def _state_presence(self) -> None:
        if self._unfit:
            self._lease.withdraw()
        else:
            self._lease.present(able=not self._check.scarce)

    def state(self) -> StandbyState:
        lease, refused = self._lease.state, self._receiver.refusal.reason
        connected = self._connected and not refused
        other = OtherAppliance(
            name=self._membership.other,
            address=self._membership.other_address,
            connected=connected,
            in_sync=lease is not None and lease.in_sync,
            behind_changes=0,
            behind_bytes=0,
            waiting_seconds=None,
            reason="" if connected else refused or self._reason,
            trouble_seconds=None if connected else round(clock.now() - self._away_since, 3),
            witness_seconds=None,
            refusal=refused,
        )
        return state_of(
            self._membership,
            lease,
            role="standby",
            since=self._since.date(),
            other=other,
            obstacle=self.obstacle,
        )

    async def hand_over(self) -> None:
        troubles = self.state().troubles
        if troubles and self.obstacle not in CHECKS and (self._connected or self.obstacle):
            raise HandOverError(troubles[0])
        try:
            refusal = await self._receiver.want_switchover()
        except ReplicationError as error:
            raise HandOverError(
                f"{self._membership.other} ({self._membership.other_address}): {error}; if it is away, this"
                " appliance takes over automatically once the lease has expired"
            ) from error
        if refusal:
            raise HandOverError(refusal)

    def _heard(self, message: object, descriptors: tuple[int, ...]) -> None:
        """Leave the supervisor's other messages to the active control."""
        if isinstance(message, messages.LinkOpened) and message.role == "api":
            self._rest.attach(self._lifeline.api_channel(descriptors[0]))
        elif isinstance(message, messages.LinkOpened) and message.role == "charon":
            self.tunnels.attach(Channel(socket.socket(fileno=descriptors[0]), messages.TunnelLink))
        else:
            self._lifeline.queue(message, descriptors)

    def _is_recovered(self) -> bool:
        return is_recovered(
            self._membership.name, self._lease.state, self._comparison, followed=self._receiver.followed
        )

    async def _compare(self) -> None:
        """Answer the other appliance if it follows this one because it is not active either."""
        while True:
            try:
                context = replication_context(self._membership, self._folder, server=True)
                with socket.create_server(("", self._membership.port)) as listening:
                    await ReplicationListener(self._comparison, context).run(listening)
            except OSError as error:
                if self._unlistened != str(error):
                    self._unlistened = str(error)
                    _log.warning("the states of the appliances are not compared", reason=self._unlistened)
            await asyncio.sleep(_AGAIN_SECONDS)

    async def _follow(self) -> None:
        context: ssl.SSLContext | None = None
        pause = _AGAIN_SECONDS
        while True:
            refused = self._receiver.refusal.reason
            try:
                context = context or replication_context(self._membership, self._folder, server=False)
                await follow_at(
                    self._membership.other_address, self._membership.port, context, self._receiver
                )
            except (ReplicationError, StoreError, OSError) as error:
                if self._reason != str(error):
                    self._reason = str(error)
                    _log.info("the active appliance is not followed", reason=self._reason)
            finally:
                if self._connected:
                    self._connected = False
                    if not (refused and self._receiver.refusal.reason):
                        self._away_since = clock.now()
            pause = min(2 * pause, _MAX_AGAIN_SECONDS) if self._receiver.refusal.reason else _AGAIN_SECONDS
            await asyncio.sleep(pause)

    async def _prepare_tunnels(self) -> None:
        while not await asyncio.to_thread(self._replica.has_hosts):
            await asyncio.sleep(_AGAIN_SECONDS)
        pool = self._settings.ipsec.pool
        self._lifeline.say(messages.TunnelsWanted(str(pool), str(pool.network_address + 1)))

    def _accepts(self, epoch: int) -> bool:
        lease = self._lease.state
        if lease is None or epoch < max(self._epoch, lease.epoch):
            return False
        if epoch > self._epoch:
            self._epoch = epoch
            self._lease.see(epoch)
        self._connected = True
        return True


async def until_activated(
    membership: Membership,
    settings: Settings,
    lifeline: ControlLifeline,
    lease: LeaseClient,
    compiler: SpecificationCompiler,
    *,
    stopping: asyncio.Event,
) -> Pair | None:
    taken_over, api, tunnels = not lifeline.activated.is_set(), None, StandbyTunnels()
    away: float | None = None
    copy_age: float | None = None
    if taken_over and not stopping.is_set():
        passive = PassiveControl(settings, membership, lifeline, lease, compiler)
        ended, loop = asyncio.Event(), asyncio.get_running_loop()
        waits = [loop.create_task(event.wait()) for event in (lifeline.activated, stopping)]
        for wait in waits:
            wait.add_done_callback(lambda _task: ended.set())
        try:
            await passive.run(ended)
            away, copy_age = passive.away_seconds, passive.copy_age
        finally:
            for wait in waits:
                wait.cancel()
        api, tunnels = passive.api, passive.tunnels
    if lifeline.epoch is None:
        return None
    return Pair(membership, lease, lifeline.epoch, api, taken_over, tunnels, away, copy_age)
