"""Keep the state of the tunnels: firewall, configuration for charon, and charon's reports.

1. Until the supervisor accepts the pool's addresses through IPsec only, `addresses` is empty, because an address
   that also works in clear text does not identify a host.
2. Every update sends charon the complete wanted state; updates keep the order of the changes.
3. Every tunnel that comes up, moves, goes down or is rejected is recorded.
4. A tunnel is closed when its certificate ends, and while its host or the address from which it came is blocked.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Container

import structlog

from appliance.base import clock
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.link import Link
from appliance.hosts.appliances import CERTIFICATE_DAYS, Appliances
from appliance.hosts.certificate_requests import AuthorityError, StoredAuthority
from appliance.hosts.host_table import HostRefusedError, HostTable
from appliance.policy.model import Address, address_of
from appliance.telemetry.audit_trail import AuditTrail

_log = structlog.get_logger()
_OPEN_SECONDS = 20.0
_TAKEN_SECONDS = 10.0
_RESTATE_SECONDS = 3600.0
_AGAIN_SECONDS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # the signer may just be starting
_JUST_AFTER_SECONDS = 0.1
_SIGNED_SECONDS = 60.0


class SignedRevocations:
    """The revocation list, signed again on request after a change of the table of hosts or a new minute."""

    def __init__(self, table: HostTable, authority: StoredAuthority) -> None:
        self._table = table
        self._authority = authority
        self._one_at_a_time = asyncio.Lock()
        self._state = (0, 0)
        self._signed = b""

    async def signed_list(self) -> bytes:
        """Return the list, signed again if needed. Raises `AuthorityError`."""
        async with self._one_at_a_time:
            state = (self._table.revision, int(clock.wall() // _SIGNED_SECONDS))
            if state != self._state:
                rows = self._table.listed_as_revoked()
                self._signed = await self._authority.revocations([(row.serial, row.moment) for row in rows])
                self._state = state
            return self._signed


class Tunnels:
    """The tunnels of the enrolled hosts."""

    def __init__(
        self,
        table: HostTable,
        trail: AuditTrail,
        authority: StoredAuthority,
        appliances: Appliances,
        *,
        listen: tuple[str, int],
        say: Callable[[messages.Message], None],
        blocked: Callable[[], Container[Address]] = tuple,
    ) -> None:
        self._table = table
        self._trail = trail
        self._authority = authority
        self._appliances = appliances
        self._listen = listen
        self._say = say
        self._blocked = blocked
        self.revocations = SignedRevocations(table, authority)
        self.seen: dict[str, messages.TunnelSeen] = {}
        self.last: dict[str, float] = {}
        self._closed_from: dict[str, Address] = {}  # hosts whose tunnel came from a blocked address
        self.charon: messages.CharonStarted | None = None
        self._enclosed: messages.TunnelsEnclosed | None = None
        self._answered = asyncio.Event()
        self._opening = asyncio.Lock()
        self._link = Link(self._on_message, self._lost)
        self._certificate: bytes | None = None
        self._needed: messages.CertificateNeeded | None = None
        self._own_end = math.inf  # of charon's certificate, in seconds since the epoch
        self._dirty = asyncio.Event()
        # The number of the last statement. Reports may still have numbers of an earlier process; a start from the clock
        # avoids the same numbers.
        self._number = clock.wall_ns()
        self._wake = asyncio.Event()
        self._changes = 0  # number of changes that charon must get
        self._stated: dict[int, int] = {}  # by unconfirmed statement: the last change that it includes
        self._taken_changes = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._failures = 0  # of the authority, one after the other

    # --- the supervisor ---

    @property
    def enclosed(self) -> bool:
        return self.esp is not None

    @property
    def esp(self) -> messages.Esp | None:
        return None if self._enclosed is None else self._enclosed.esp

    @property
    def obstacle(self) -> str:
        return self._enclosed.reason if self._enclosed else "the supervisor has not answered yet"

    @property
    def waits(self) -> str:
        return self._authority.waits

    @property
    def addresses(self) -> dict[str, Address]:
        return self._table.addresses() if self.enclosed else {}

    async def start(self) -> None:
        """Open the tunnels if hosts are enrolled; a failure is only logged, so nodes are still served."""
        if not self._table.admitted_hosts():
            return
        try:
            await self.open()
        except HostRefusedError as error:
            _log.error("enrolled hosts cannot connect", reason=str(error))

    def answered(self, message: messages.TunnelsEnclosed) -> None:
        self._enclosed = message
        self._answered.set()

    async def open(self) -> None:
        """Open the tunnels, after the supervisor has blocked clear text for the pool. Raises `HostRefusedError`."""
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
                async with asyncio.timeout(_OPEN_SECONDS):
                    await self._answered.wait()
            except TimeoutError:
                raise HostRefusedError("the supervisor did not answer: try again", ours=True) from None
            if not self.enclosed:
                raise HostRefusedError(self.obstacle, ours=True)

    # --- the process that runs charon ---

    def attach(self, link: Channel, needed: messages.CertificateNeeded | None = None) -> None:
        self._certificate = self.charon = self._needed = None
        self._own_end = math.inf
        self._link.attach(link)
        if needed is not None:
            self._spawn(needed)

    def state_anew(self) -> None:
        self._changes += 1
        self._dirty.set()

    async def run(self, each_hour: Callable[[], None]) -> None:
        """Update charon after a change, when a certificate ends, and every hour with a new list.

        `each_hour()` is called before each update.
        """
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._until_it_changes()):
                    await self._dirty.wait()
            each_hour()
            self._dirty.clear()
            self._renew_own()
            try:
                await self._state()
                self._failures = 0
            except AuthorityError as error:
                _log.warning("charon is updated later", reason=str(error))
                asyncio.get_running_loop().call_later(self._again(), self._dirty.set)

    def _until_it_changes(self) -> float:
        """Return the seconds until the next update: charon does not close a tunnel whose certificate ends."""
        now = clock.wall()
        dates = [self._own_end, *(row.expires for row in self._table.admitted_hosts())]
        ends = [date - now for date in dates if date > now]
        return min([_RESTATE_SECONDS, *(end + _JUST_AFTER_SECONDS for end in ends)])

    def _renew_own(self) -> None:
        """Ask for another certificate of charon if its present one has ended.

        charon asks each month, in time, unless the clock was set forward: then no host could connect until then.
        """
        if self._needed is not None and self._own_end <= clock.wall():
            self._own_end = math.inf
            self._spawn(self._needed)

    async def until_taken(self) -> bool:
        wanted = self._changes
        deadline = clock.now() + _TAKEN_SECONDS
        while self._taken_changes < wanted:
            self._wake.clear()
            try:
                async with asyncio.timeout(deadline - clock.now()):
                    await self._wake.wait()
            except TimeoutError:
                return False
        return True

    async def _state(self) -> None:
        link, certificate, esp = self._link.channel, self._certificate, self.esp
        if link is None or certificate is None or esp is None:
            return
        authority = await self._authority.certificate()
        revocations = await self.revocations.signed_list()
        now, blocked = clock.wall(), self._blocked()
        self._note_closed(blocked)
        hosts = [
            messages.TunnelHost(row.name, row.address, row.serial)
            for row in self._table.admitted_hosts()
            if row.expires > now
            and address_of(row.address) not in blocked
            and row.name not in self._closed_from
        ]
        self._number += 1
        self._stated[self._number] = self._changes
        message = messages.TunnelsStated(
            self._number, esp, self._table.own_address, authority, certificate, revocations, hosts
        )
        link.send(message)

    def _note_closed(self, blocked: Container[Address]) -> None:
        """Keep tunnels that came from a blocked address closed until it is free, wherever their hosts try again."""
        came_from = self._closed_from | {name: _real(seen.remote) for name, seen in self.seen.items()}
        self._closed_from = {
            name: one for name, one in came_from.items() if one is not None and one in blocked
        }

    def _came_from(self, remote: str) -> None:
        address = _real(remote)
        if address is not None and address in self._blocked():
            self.state_anew()

    def _on_message(self, message: object) -> None:
        match message:
            case messages.CertificateNeeded():
                self._spawn(message)
            case messages.CharonStarted():
                self.charon = message
            case messages.TunnelChanged(name, up, remote):
                self._changed(name, up, remote)
            case messages.TunnelRefused(remote, reason, packets) if packets:
                self._trail.happened("packets refused", reason, decision="deny", host=remote, packets=packets)
            case messages.TunnelRefused(remote, reason):
                self._trail.happened("tunnel refused", reason, decision="deny", host=remote or None)
            case messages.TunnelsReported(taken, rows):
                self._on_report(rows)
                # An unknown number is of an earlier process; if the clock was set back, it may be the greater one.
                if taken in self._stated:
                    for number in [statement for statement in self._stated if statement <= taken]:
                        self._taken_changes = self._stated.pop(number)
                self._wake.set()

    def _spawn(self, needed: messages.CertificateNeeded) -> None:
        self._needed = needed
        task = asyncio.get_running_loop().create_task(self._certify(needed))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _certify(self, needed: messages.CertificateNeeded) -> None:
        link = self._link.channel
        while link is self._link.channel:
            try:
                certificate = await self._own_certificate(needed)
            except AuthorityError as error:
                _log.warning("charon waits for its certificate", reason=str(error))
                await asyncio.sleep(self._again())
                continue
            self._certificate = certificate
            self._dirty.set()
            return

    def _again(self) -> float:
        self._failures += 1
        return _AGAIN_SECONDS[min(self._failures, len(_AGAIN_SECONDS)) - 1]

    async def _own_certificate(self, needed: messages.CertificateNeeded) -> bytes:
        """Return charon's certificate; without the authority's key, the other appliance issued it."""
        obstacle = await self._authority.obstacle()
        kept = self._appliances.certificate(needed.key) if obstacle else b""
        if kept:
            self._appliances.note_own(needed.key)
            return kept
        made = await self._authority.issue(needed.request, messages.APPLIANCE_NAME, CERTIFICATE_DAYS)
        self._appliances.certified(needed.key, made)
        self._own_end = made.expires
        return made.certificate

    def _lost(self, _reason: str) -> None:
        self._certificate = self.charon = None
        for name in list(self.seen):
            self._went_down(name, "the process that runs charon exited")

    # --- up and down ---

    def _changed(self, name: str, up: bool, remote: str) -> None:
        row = self._table.rows.get(name)
        if row is None:
            return
        if not up:
            self._went_down(name, "closed")
        elif name not in self.seen:
            self.seen[name] = messages.TunnelSeen(name, remote, 0, 0, 0)
            self.last[name] = clock.wall()
            self._trail.happened(
                "tunnel up", f"{name} is connected from {remote}", host=row.address, name=name, remote=remote
            )
            self._came_from(remote)

    def _on_report(self, rows: list[messages.TunnelSeen]) -> None:
        now = clock.wall()
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
        """Record that a host moved: its tunnel stays open, but a stolen kit would look the same."""
        before = self.seen[row.name].remote
        if row.remote != before:
            self._trail.happened(
                "tunnel moved",
                f"{row.name} now connects from {row.remote}, previously from {before}",
                host=self._table.rows[row.name].address,
                name=row.name,
                remote=row.remote,
                before=before,
            )
            self._came_from(row.remote)

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


def _real(remote: str) -> Address | None:
    with contextlib.suppress(ValueError):
        return address_of(remote.partition("%")[0])
    return None
