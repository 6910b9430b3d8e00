"""The tunnels as they stand: the firewall around them, what charon is told, what it tells.

Invariants:

1. `open` first has the supervisor take the pool's addresses through IPsec only; before that, `enclosed` is False
   and `addresses` is empty: where clear text is not kept out, they stand for nobody.
2. What charon is to have is stated whole each time, in the order in which it came about.
3. Every tunnel that comes up, moves, goes down or is refused is recorded; packets that charon dropped are counted.
4. A certificate's end is the end of its tunnel.
"""

import asyncio
import contextlib
import ipaddress
import time
from collections.abc import Callable

import structlog

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.link import Link
from appliance.hosts.certificate_requests import Authority, AuthorityError
from appliance.hosts.host_table import HostRefusedError, HostTable
from appliance.hosts.revocation_list import RevocationList
from appliance.policy.model import Address
from appliance.telemetry.audit_trail import AuditTrail

_log = structlog.get_logger()
_APPLIANCE_DAYS = 90.0
_OPEN_SECONDS = 20.0
_TAKEN_SECONDS = 10.0
_RESTATE_SECONDS = 3600.0
_AGAIN_SECONDS = 5.0
_JUST_AFTER_SECONDS = 0.1


class Tunnels:
    """All tunnels."""

    def __init__(
        self,
        table: HostTable,
        trail: AuditTrail,
        authority: Authority,
        *,
        listen: tuple[str, int],
        say: Callable[[messages.Message], None],
    ) -> None:
        self._table = table
        self._trail = trail
        self._authority = authority
        self._listen = listen
        self._say = say
        self.revocations = RevocationList(table, authority)
        self.seen: dict[str, messages.TunnelSeen] = {}
        self.last: dict[str, float] = {}
        self.charon: messages.CharonStarted | None = None
        self._enclosed: messages.TunnelsEnclosed | None = None
        self._answered = asyncio.Event()
        self._opening = asyncio.Lock()
        self._link = Link(self._received, self._lost)
        self._certificate: bytes | None = None
        self._dirty = asyncio.Event()
        # Of the last statement: no number of an earlier life, which charon's process may still report, comes again.
        self._number = time.time_ns()
        self._wake = asyncio.Event()
        self._changes = 0  # that charon is to be told
        self._stated: dict[int, int] = {}  # statements on their way, by number: which change they have last
        self._taken_changes = 0
        self._tasks: set[asyncio.Task[None]] = set()

    # --- the supervisor ---

    @property
    def enclosed(self) -> bool:
        """Whether the pool's addresses are taken through IPsec only."""
        return self.esp is not None

    @property
    def esp(self) -> messages.Esp | None:
        """Where ESP runs; None: no tunnels are open."""
        return None if self._enclosed is None else self._enclosed.esp

    @property
    def obstacle(self) -> str:
        """Why no tunnels are open."""
        return self._enclosed.reason if self._enclosed else "the supervisor has not answered yet"

    @property
    def addresses(self) -> dict[str, Address]:
        """What `host:NAME` means in the policy now."""
        if not self.enclosed:
            return {}
        return {row.name: ipaddress.ip_address(row.address) for row in self._table.admitted()}

    async def start(self) -> None:
        """Before nodes are served: have the addresses closed to clear text, if any host is enrolled."""
        if not self._table.admitted():
            return
        try:
            await self.open()
        except HostRefusedError as error:
            _log.error("enrolled hosts stay outside", reason=str(error))

    def answered(self, message: messages.TunnelsEnclosed) -> None:
        """The supervisor's answer to `open`."""
        self._enclosed = message
        self._answered.set()

    async def open(self) -> None:
        """Have tunnels, if there are none yet. Raises `HostRefusedError`."""
        async with self._opening:
            if self.enclosed:
                return
            own = self._table.own_address
            if self._listen[0] not in ("0.0.0.0", own):  # noqa: S104  compared only
                raise HostRefusedError(
                    f"hosts in tunnels reach the appliance at {own}, but it listens on"
                    f" {self._listen[0]} only: set `listen: 0.0.0.0:{self._listen[1]}`"
                )
            self._answered.clear()
            self._say(messages.TunnelsWanted(str(self._table.pool), own))
            try:
                await asyncio.wait_for(self._answered.wait(), _OPEN_SECONDS)
            except TimeoutError:
                raise HostRefusedError("the supervisor did not answer: try again", ours=True) from None
            if not self.enclosed:
                raise HostRefusedError(self.obstacle, ours=True)

    # --- the process that runs charon ---

    def attach(self, link: Channel) -> None:
        """A new life of that process; it asks for its certificate first."""
        self._certificate = self.charon = None
        self._link.attach(link)

    def state_anew(self) -> None:
        """Tell charon what it is to have, soon."""
        self._changes += 1
        self._dirty.set()

    async def run(self, each_hour: Callable[[], None]) -> None:
        """State what charon is to have: when it changes, when a certificate ends, every hour (the list's age).

        `each_hour()` is called before that.
        """
        while True:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._dirty.wait(), self._until_it_changes())
            each_hour()
            self._dirty.clear()
            try:
                await self._state()
            except AuthorityError as error:
                _log.warning("charon is told later", reason=str(error))
                asyncio.get_running_loop().call_later(_AGAIN_SECONDS, self._dirty.set)

    def _until_it_changes(self) -> float:
        """Seconds until something changes by itself: charon would keep a tunnel whose certificate has ended."""
        now = time.time()
        ends = [row.expires - now for row in self._table.admitted() if row.expires > now]
        return min([_RESTATE_SECONDS, *(end + _JUST_AFTER_SECONDS for end in ends)])

    async def until_taken(self) -> bool:
        """Wait until charon has what `state_anew` was called for; False when it does not come in time."""
        wanted = self._changes
        deadline = time.monotonic() + _TAKEN_SECONDS
        while self._taken_changes < wanted:
            self._wake.clear()
            try:
                await asyncio.wait_for(self._wake.wait(), deadline - time.monotonic())
            except TimeoutError:
                return False
        return True

    async def _state(self) -> None:
        link, certificate, esp = self._link.channel, self._certificate, self.esp
        if link is None or certificate is None or esp is None:
            return
        authority = await self._authority.certificate()
        revocations = await self.revocations.signed()
        now = time.time()
        hosts = [
            messages.TunnelHost(row.name, row.address, row.serial)
            for row in self._table.admitted()
            if row.expires > now
        ]
        self._number += 1
        self._stated[self._number] = self._changes
        message = messages.TunnelsStated(
            self._number, esp, self._table.own_address, authority, certificate, revocations, hosts
        )
        link.send(message)

    def _received(self, message: object) -> None:
        match message:
            case messages.CertificateNeeded(request):
                self._spawn(request)
            case messages.CharonStarted():
                self.charon = message
            case messages.TunnelChanged(name, up, remote):
                self._changed(name, up, remote)
            case messages.TunnelRefused(remote, reason, packets) if packets:
                self._trail.happened("packets refused", reason, decision="deny", host=remote, packets=packets)
            case messages.TunnelRefused(remote, reason):
                self._trail.happened("tunnel refused", reason, decision="deny", host=remote)
            case messages.TunnelsReported(taken, rows):
                self._reported(rows)
                # After the clock was set back, a greater number may be of an earlier life.
                if taken in self._stated:
                    for number in [statement for statement in self._stated if statement <= taken]:
                        self._taken_changes = self._stated.pop(number)
                self._wake.set()

    def _spawn(self, request: bytes) -> None:
        task = asyncio.get_running_loop().create_task(self._certify(request))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _certify(self, request: bytes) -> None:
        link = self._link.channel
        while link is self._link.channel:
            try:
                made = await self._authority.issue(request, messages.APPLIANCE_NAME, _APPLIANCE_DAYS)
            except AuthorityError as error:
                _log.warning("charon waits for its certificate", reason=str(error))
                await asyncio.sleep(_AGAIN_SECONDS)
                continue
            self._certificate = made.certificate
            self._dirty.set()
            return

    def _lost(self, _reason: str) -> None:
        self._certificate = self.charon = None
        for name in list(self.seen):
            self._went_down(name, "the process that runs charon ended")

    # --- up and down ---

    def _changed(self, name: str, up: bool, remote: str) -> None:
        row = self._table.rows.get(name)
        if row is None:
            return
        if not up:
            self._went_down(name, "closed")
        elif name not in self.seen:
            self.seen[name] = messages.TunnelSeen(name, remote, 0, 0, 0)
            self.last[name] = time.time()
            self._trail.happened(
                "tunnel up", f"{name} is here, from {remote}", host=row.address, name=name, remote=remote
            )

    def _reported(self, rows: list[messages.TunnelSeen]) -> None:
        now = time.time()
        standing = {row.name: row for row in rows if row.name in self._table.rows}
        for name in set(self.seen) - set(standing):
            self._went_down(name, "gone")
        for name, row in standing.items():
            self._changed(name, True, row.remote)
            self._look_where(row)
            if row.bytes_in > self.seen[name].bytes_in:
                self.last[name] = now
            self.seen[name] = row

    def _look_where(self, row: messages.TunnelSeen) -> None:
        """A host that moves keeps its tunnel; a copy of its kit elsewhere would look like this, too."""
        before = self.seen[row.name].remote
        if row.remote != before:
            self._trail.happened(
                "tunnel moved",
                f"{row.name} comes from {row.remote} now, before from {before}",
                host=self._table.rows[row.name].address,
                name=row.name,
                remote=row.remote,
                before=before,
            )

    def _went_down(self, name: str, reason: str) -> None:
        seen = self.seen.pop(name, None)
        if seen is None:
            return
        self._trail.happened(
            "tunnel down",
            f"the tunnel of {name} is down: {reason}",
            host=self._table.rows[name].address,
            name=name,
            remote=seen.remote,
        )
