"""The hosts that come through tunnels: enrolled, renewed, listed and revoked here.

Invariants:

1. A name has one virtual address for good; the address of a revoked host is given to no other.
2. `addresses` (what `host:NAME` means in the policy) is empty until the supervisor has said that these addresses
   are taken through IPsec only: where clear text is not kept out, they stand for nobody.
3. A revoked host is out of the policy, and its registrations are taken back, before anything is awaited.
4. What charon is to have is stated whole each time, in the order in which it came about.
"""

import asyncio
import contextlib
import ipaddress
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import structlog

from appliance.audit.record import Severity
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages import (
    APPLIANCE_NAME,
    CertificateMade,
    CertificateNeeded,
    Message,
    TunnelChanged,
    TunnelHost,
    TunnelRefused,
    TunnelSeen,
    TunnelsEnclosed,
    TunnelsReported,
    TunnelsStated,
    TunnelsWanted,
)
from appliance.master.authority import Authority, AuthorityError
from appliance.master.declared import DeclaredHost, DeclaredHostsError, read_declared
from appliance.master.recorder import Recorder
from appliance.policy.model import Address
from appliance.store.state import HostRow, StateStore

_log = structlog.get_logger()
_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?")
_APPLIANCE_DAYS = 90.0
_OPEN_SECONDS = 20.0
_TAKEN_SECONDS = 10.0
_RESTATE_SECONDS = 3600.0
_AGAIN_SECONDS = 5.0
_SOON_SECONDS = 14 * 86_400.0


class HostRefusedError(Exception):
    """It is not done; the text says why. `ours`: the appliance cannot do it now."""

    def __init__(self, reason: str, *, ours: bool = False) -> None:
        super().__init__(reason)
        self.ours = ours


class Hosts:
    """All hosts.

    `changed()` is called when `addresses` has changed, `expel(address, reason)` takes back what a host has; both
    say how much that was.
    """

    def __init__(
        self,
        store: StateStore,
        recorder: Recorder,
        authority: Authority,
        *,
        pool: ipaddress.IPv4Network,
        declared: Path,
        listen: tuple[str, int],
        say: Callable[[Message], None],
    ) -> None:
        self._store = store
        self._recorder = recorder
        self._authority = authority
        self._pool = pool
        self._declared_file = declared
        self._listen = listen
        self._say = say
        self._rows = {row.name: row for row in store.hosts()}
        self._revoked = store.revoked_certificates()
        self._seen: dict[str, TunnelSeen] = {}
        self._last: dict[str, float] = {}
        self._enclosed: TunnelsEnclosed | None = None
        self._answered = asyncio.Event()
        self._opening = asyncio.Lock()
        self._changing = asyncio.Lock()
        self._link: Channel | None = None
        self._certificate: bytes | None = None
        self._dirty = asyncio.Event()
        # Of the last statement: greater than any of an earlier life, which charon's process may still report.
        self._number = time.time_ns()
        self._wake = asyncio.Event()
        self._taken_number = 0
        self.changed: Callable[[], int] = lambda: 0
        self.expel: Callable[[Address, str], int] = lambda address, reason: 0  # noqa: ARG005 - set by control

    # --- what others ask ---

    @property
    def own_address(self) -> str:
        """The appliance's address in the tunnels: the first of the pool."""
        return str(self._pool.network_address + 1)

    @property
    def addresses(self) -> dict[str, Address]:
        """What `host:NAME` means now."""
        if self._enclosed is None or self._enclosed.esp is None:
            return {}
        return {row.name: ipaddress.ip_address(row.address) for row in self._admitted()}

    def rows(self) -> list[dict[str, Any]]:
        """Every host, enrolled or declared, as `rosrv host list` shows it."""
        declared, _error = self._declared()
        rows = [self._row(row, declared) for row in self._rows.values()]
        rows += [
            {**_NOBODY, "name": one.name, "address": one.address, "declared": True, "state": "not enrolled"}
            for one in declared.values()
            if one.name not in self._rows
        ]
        return sorted(rows, key=lambda row: str(row["name"]))

    def status(self) -> dict[str, Any]:
        """For `rosrv status`: where ESP runs, how many tunnels stand, what a person should look at."""
        _hosts, error = self._declared()
        enclosed = self._enclosed
        return {
            "esp": None if enclosed is None else enclosed.esp,
            "pool": str(self._pool),
            "address": self.own_address,
            "enrolled": len(self._admitted()),
            "up": len(self._seen),
            "troubles": [*self._troubles(), *([error] if error else [])],
        }

    # --- what operators do ---

    async def add(
        self, name: str, request: str, days: float, address: str | None, who: str
    ) -> dict[str, Any]:
        """Enrol a host; what its kit is made of. Raises `HostRefusedError`."""
        async with self._changing:
            row = self._rows.get(name)
            if row is not None and row.revoked is None:
                raise HostRefusedError(
                    f"{name} is enrolled already: `rosrv host kit {name}` gives it a new certificate"
                )
            self._require_name(name)
            wanted = self._address_for(name, address)
            await self._open()
            made = await self._issue(name, request, days)
            self._keep(HostRow(name, wanted, made.serial, made.expires, time.time(), None))
            self._recorder.happened(
                "host enrolled",
                f"{name} may come through its tunnel as {wanted}",
                severity=Severity.NOTICE,
                name=name,
                address=wanted,
                serial=made.serial,
                expires=made.expires,
                who=who,
            )
            return await self._finish(name, made)

    async def renew(self, name: str, request: str, days: float, who: str) -> dict[str, Any]:
        """A new certificate for a host, the one before revoked. Raises `HostRefusedError`."""
        async with self._changing:
            row = self._admitted_row(name)
            await self._open()
            made = await self._issue(name, request, days)
            self._admitted_row(name)  # it may have been revoked meanwhile
            self._revoke_serial(row.serial)
            self._keep(HostRow(name, row.address, made.serial, made.expires, row.enrolled, None))
            self._recorder.happened(
                "host renewed",
                f"{name} has a new certificate; its tunnel comes back with it",
                severity=Severity.NOTICE,
                name=name,
                serial=made.serial,
                replaced=row.serial,
                expires=made.expires,
                who=who,
            )
            return await self._finish(name, made)

    async def revoke(self, name: str, who: str) -> dict[str, Any]:
        """Let a host in no more and cut what it has. Raises `HostRefusedError`."""
        row = self._admitted_row(name)
        self._revoke_serial(row.serial)
        taken = self._keep(HostRow(name, row.address, row.serial, row.expires, row.enrolled, time.time()))
        taken += self.expel(ipaddress.ip_address(row.address), f"the host {name} was revoked")
        self._recorder.happened(
            "host revoked",
            f"{name} ({row.address}) may no longer come; {taken} registrations and grants were taken back",
            severity=Severity.WARNING,
            name=name,
            address=row.address,
            serial=row.serial,
            taken_back=taken,
            who=who,
        )
        await self._store.settled()
        return {"name": name, "address": row.address, "serial": row.serial, "taken_back": taken}

    # --- the supervisor ---

    async def start(self) -> None:
        """Before nodes are served: have the addresses closed to clear text, if any host is enrolled."""
        if not self._admitted():
            return
        try:
            await self._open()
        except HostRefusedError as error:
            _log.error("enrolled hosts stay outside", reason=str(error))

    def enclosed(self, message: TunnelsEnclosed) -> None:
        """The supervisor's answer."""
        self._enclosed = message
        self._answered.set()

    async def _open(self) -> None:
        async with self._opening:
            if self._enclosed is not None and self._enclosed.esp is not None:
                return
            if self._listen[0] not in ("0.0.0.0", self.own_address):  # noqa: S104  compared only
                raise HostRefusedError(
                    f"hosts in tunnels reach the appliance at {self.own_address}, but it listens on"
                    f" {self._listen[0]} only: set `listen: 0.0.0.0:{self._listen[1]}`"
                )
            self._answered.clear()
            self._say(TunnelsWanted(str(self._pool), self.own_address))
            try:
                await asyncio.wait_for(self._answered.wait(), _OPEN_SECONDS)
            except TimeoutError:
                raise HostRefusedError("the supervisor did not answer: try again", ours=True) from None
            if self._enclosed is None or self._enclosed.esp is None:
                reason = self._enclosed.reason if self._enclosed else "no answer"
                raise HostRefusedError(reason, ours=True)

    # --- the process that runs charon ---

    def attach(self, link: Channel) -> None:
        """A new life of that process; it asks for its certificate first."""
        if self._link is not None:
            self._link.close()
        self._link, self._certificate = link, None
        link.attach(
            asyncio.get_running_loop(),
            lambda message, _descriptors: self._received(message),
            lambda: self._lost(link),
        )

    async def run(self) -> None:
        """State what charon is to have whenever it changes, and every hour (expired hosts, the list's age)."""
        while True:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._dirty.wait(), _RESTATE_SECONDS)
            self._dirty.clear()
            try:
                await self._state()
            except AuthorityError as error:
                _log.warning("charon is told later", reason=str(error))
                asyncio.get_running_loop().call_later(_AGAIN_SECONDS, self._dirty.set)

    def _lost(self, link: Channel) -> None:
        if self._link is not link:
            return
        self._link = self._certificate = None
        for name in list(self._seen):
            self._went_down(name, "the process that runs charon ended")

    def _received(self, message: object) -> None:
        match message:
            case CertificateNeeded(request):
                task = asyncio.get_running_loop().create_task(self._certify(request))
                task.add_done_callback(lambda done: done.exception())
            case TunnelChanged(name, up, remote):
                self._tunnel_changed(name, up, remote)
            case TunnelRefused(remote, reason):
                self._recorder.happened(
                    "tunnel refused", reason, severity=Severity.WARNING, decision="deny", host=remote
                )
            case TunnelsReported(taken, rows):
                self._reported(rows)
                self._taken_number = taken
                self._wake.set()

    async def _certify(self, request: bytes) -> None:
        link = self._link
        while link is self._link:
            try:
                made = await self._authority.issue(request, APPLIANCE_NAME, _APPLIANCE_DAYS)
            except AuthorityError as error:
                _log.warning("charon waits for its certificate", reason=str(error))
                await asyncio.sleep(_AGAIN_SECONDS)
                continue
            self._certificate = made.certificate
            self._dirty.set()
            return

    async def _state(self) -> None:
        enclosed = self._enclosed
        link, certificate = self._link, self._certificate
        if link is None or certificate is None or enclosed is None or enclosed.esp is None:
            return
        authority = await self._authority.certificate()
        revocations = await self._authority.revocations(list(self._revoked))
        now = time.time()
        hosts = [
            TunnelHost(row.name, row.address, row.serial) for row in self._admitted() if row.expires > now
        ]
        self._number += 1
        message = TunnelsStated(
            self._number, enclosed.esp, self.own_address, authority, certificate, revocations, hosts
        )
        try:
            link.send(message)
        except ChannelClosedError:
            self._lost(link)

    def _tunnel_changed(self, name: str, up: bool, remote: str) -> None:
        row = self._rows.get(name)
        if row is None:
            return
        if not up:
            self._went_down(name, "closed")
        elif name not in self._seen:
            self._seen[name] = TunnelSeen(name, remote, 0, 0, 0)
            self._last[name] = time.time()
            self._recorder.happened(
                "tunnel up",
                f"{name} is here, from {remote}",
                severity=Severity.NOTICE,
                host=row.address,
                name=name,
                remote=remote,
            )

    def _reported(self, rows: list[TunnelSeen]) -> None:
        now = time.time()
        standing = {row.name: row for row in rows if row.name in self._rows}
        for name in set(self._seen) - set(standing):
            self._went_down(name, "gone")
        for name, row in standing.items():
            self._tunnel_changed(name, True, row.remote)
            if row.bytes_in > self._seen[name].bytes_in:
                self._last[name] = now
            self._seen[name] = row

    def _went_down(self, name: str, reason: str) -> None:
        seen = self._seen.pop(name, None)
        if seen is None:
            return
        self._recorder.happened(
            "tunnel down",
            f"the tunnel of {name} is down: {reason}",
            severity=Severity.NOTICE,
            host=self._rows[name].address,
            name=name,
            remote=seen.remote,
        )

    # --- inside ---

    def _admitted(self) -> list[HostRow]:
        return [row for row in self._rows.values() if row.revoked is None]

    def _admitted_row(self, name: str) -> HostRow:
        row = self._rows.get(name)
        if row is None or row.revoked is not None:
            known = ", ".join(one.name for one in self._admitted()) or "none"
            raise HostRefusedError(f"no host {name[:80]!r} is enrolled; enrolled are: {known}")
        return row

    def _require_name(self, name: str) -> None:
        if not _NAME.fullmatch(name) or name == APPLIANCE_NAME:
            raise HostRefusedError(
                f"{name[:80]!r} is no name for a host: letters, digits and . _ -, beginning and ending with a"
                f" letter or digit, at most 63, and not {APPLIANCE_NAME}"
            )

    def _address_for(self, name: str, wanted: str | None) -> str:
        declared = self._declared()[0].get(name)
        before = self._rows.get(name)
        kept = before.address if before else declared.address if declared else None
        if wanted is None and kept is not None:
            wanted = kept
        taken = {row.address: row.name for row in self._rows.values() if row.name != name}
        if wanted is None:
            reserved = {one.address for one in self._declared()[0].values()}
            for one in list(self._pool.hosts())[1:]:
                if str(one) not in taken and str(one) not in reserved:
                    return str(one)
            raise HostRefusedError(f"every address of {self._pool} is a host's: take a larger ipsec.pool")
        try:
            address = ipaddress.IPv4Address(wanted)
        except ValueError:
            raise HostRefusedError(f"{wanted[:80]!r} is no IPv4 address") from None
        if address not in self._pool or str(address) == self.own_address:
            raise HostRefusedError(f"{address} is not an address of a host in {self._pool}")
        if str(address) in taken:
            raise HostRefusedError(f"{address} is the address of {taken[str(address)]}")
        return str(address)

    async def _issue(self, name: str, request: str, days: float) -> CertificateMade:
        try:
            return await self._authority.issue(request.encode(), name, days)
        except AuthorityError as error:
            raise HostRefusedError(str(error), ours=not error.refused) from error

    def _revoke_serial(self, serial: str) -> None:
        now = time.time()
        self._revoked.append((serial, now))
        self._store.save_revoked_certificate(serial, now)

    def _keep(self, row: HostRow) -> int:
        self._rows[row.name] = row
        self._store.save_host(row)
        self._dirty.set()
        return self.changed()

    async def _finish(self, name: str, made: CertificateMade) -> dict[str, Any]:
        await self._store.settled()
        row = self._rows[name]
        try:
            authority = await self._authority.certificate()
        except AuthorityError as error:
            raise HostRefusedError(f"{error}; then `rosrv host kit {name}`", ours=True) from error
        taken = await self._until_taken()
        return {
            "name": name,
            "address": row.address,
            "warning": None if taken else "charon does not know it yet; `rosrv status` and the log say why",
            "appliance": self.own_address,
            "master": f"http://{self.own_address}:{self._listen[1]}",
            "serial": made.serial,
            "expires": made.expires,
            "certificate": made.certificate.decode(),
            "authority": authority.decode(),
        }

    async def _until_taken(self) -> bool:
        """Wait until charon has what was stated after now; False when it does not come in time."""
        wanted = self._number + 1
        deadline = time.monotonic() + _TAKEN_SECONDS
        while self._taken_number < wanted:
            self._wake.clear()
            try:
                await asyncio.wait_for(self._wake.wait(), deadline - time.monotonic())
            except TimeoutError:
                return False
        return True

    def _row(self, row: HostRow, declared: dict[str, DeclaredHost]) -> dict[str, Any]:
        now, seen = time.time(), self._seen.get(row.name)
        if row.revoked is not None:
            state = "revoked"
        elif row.expires <= now:
            state = "expired"
        else:
            state = "up" if seen else "down"
        return {
            "name": row.name,
            "address": row.address,
            "state": state,
            "declared": row.name in declared,
            "serial": row.serial,
            "expires": row.expires,
            "enrolled": row.enrolled,
            "revoked": row.revoked,
            "remote": seen.remote if seen else None,
            "seconds": seen.seconds if seen else None,
            "bytes_in": seen.bytes_in if seen else None,
            "bytes_out": seen.bytes_out if seen else None,
            "last_seen": self._last.get(row.name),
        }

    def _troubles(self) -> list[str]:
        now, found = time.time(), []
        if self._admitted() and not self.addresses:
            reason = self._enclosed.reason if self._enclosed else "the supervisor has not answered yet"
            found.append(f"enrolled hosts stay outside: {reason}")
        for row in self._admitted():
            left = row.expires - now
            if left <= 0:
                found.append(f"the certificate of {row.name} has ended: rosrv host kit {row.name}")
            elif left < _SOON_SECONDS:
                days = int(left // 86_400)
                found.append(f"the certificate of {row.name} ends in {days} days: rosrv host kit {row.name}")
        return found

    def _declared(self) -> tuple[dict[str, DeclaredHost], str]:
        try:
            return read_declared(self._declared_file), ""
        except DeclaredHostsError as error:
            return {}, str(error)


_NOBODY: dict[str, Any] = {
    "serial": None,
    "expires": None,
    "enrolled": None,
    "revoked": None,
    "remote": None,
    "seconds": None,
    "bytes_in": None,
    "bytes_out": None,
    "last_seen": None,
}
