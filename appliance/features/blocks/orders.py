"""Block hosts, and lift blocks on order or when their time ends. Withdrawn registrations then return."""

import socket
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping

from msgspec.structs import asdict, replace

from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.withdrawal import caller_host, take_effect
from appliance.control.assembly.host_blocks import BLOCKS, BlockTable
from appliance.control.assembly.policies import Policies
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.features.blocks import requests
from appliance.features.blocks.requests import (
    HostBlock,
    HostBlocks,
    HostUnblock,
)
from appliance.hosts.host_table import HostRefusedError
from appliance.policy.host_names import HostNames, UnknownHostNameError
from appliance.policy.live_rights import LiveRight
from appliance.policy.model import Address, address_of, plain_address
from appliance.store.ends import EndTable
from appliance.store.host_tables import HostBlockRow
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

MAX = 1000
_NOT_BLOCKED = "not blocked"
_FEW = 10  # registrations: two nodes; a robot has more
_REGISTERED = {
    "registerPublisher": "publications",
    "registerSubscriber": "subscriptions",
    "registerService": "services",
    "subscribeParam": "parameters",
}


class BlockOrders:
    """Answers operators, and ends each block when its time ends."""

    def __init__(
        self,
        blocks: BlockTable,
        policies: Policies,
        store: StateStore,
        trail: AuditTrail,
        ends: EndTable,
        *,
        live: Callable[[], list[LiveRight]],  # the rights that a change of the policy may end
        connected: Callable[[], Iterable[Collection[str]]],  # the two hosts of each connection
        enrolled: Callable[[], Mapping[str, str]],  # addresses of enrolled hosts and doors, by name
        remotes: Callable[[], Mapping[str, str]],  # outer addresses of hosts in tunnels, by name
        uses: Callable[[Address], list[str]],  # besides registrations, connections and tunnels
        carried_out: Callable[[], Awaitable[None]],
        is_own: Callable[[Address], bool],  # whether this machine has the address
    ) -> None:
        self._uses = uses
        self._is_own = is_own
        self._blocks = blocks
        self._policies = policies
        self._store = store
        self._trail = trail
        self._live = live
        self._connected = connected
        self._enrolled = enrolled
        self._remotes = remotes
        self._carried_out = carried_out
        ends.when_due(BLOCKS, self._due)

    async def list_blocks(self, _request: HostBlocks) -> requests.BlockedHosts:
        return requests.BlockedHosts([self._row(row) for row in self._blocks.rows().values()])

    async def block(self, request: HostBlock, who: str) -> requests.HostBlocked:
        address = self._address(request.address)
        _require_sensible(request)
        if str(address) not in self._enrolled().values():
            self._require_possible(address)
        before = self._held_by(address)
        if not request.force:
            self._require_not_the_robot(address, before)
            self._require_not_the_caller(address)
        earlier = self._blocks.rows().get(address)
        if earlier is None and len(self._blocks) >= MAX:
            raise HostRefusedError(f"{MAX} hosts are blocked, the limit: lift a block (rosrv host blocks)")
        replaced = None if earlier is None else self._row(earlier)
        if request.dry_run:
            planned = HostBlockRow(str(address), clock.wall(), who, request.note)
            until = None if request.for_seconds is None else planned.since + request.for_seconds
            return self._answer(replace(self._row(planned), until=until), before, replaced)
        endless = replaced is not None and replaced.until is None and request.for_seconds is None
        if replaced is not None and endless and request.note in ("", replaced.note):  # the same block
            return self._answer(replaced, requests.BlockEnded(0, 0, 0, 0, 0), replaced)
        take_effect()
        row = self._blocks.put(address, seconds=request.for_seconds, who=who, note=request.note)
        self._policies.decide_again()
        # The relays report later that they closed the connections.
        ended = replace(
            _difference(before, self._held_by(address)), connections=before.connections, uses=before.uses
        )
        shown = self._row(row)
        self._trail.happened(
            "host blocked",
            f"{address} is {self._blocks.reasons[address]}",
            host=row.address,
            whole=True,
            address=row.address,
            who=who,
            until=shown.until,
            note=row.note,
            replaced=replaced is not None,
            earlier=_NOT_BLOCKED if earlier is None else _words(earlier),
            forced=request.force,
            ended=ended,
        )
        try:
            await self._store.until_settled()
        except StoreError as error:
            raise StoreError(
                f"{address} is blocked now, but a stop of the appliance ends it: {error}"
            ) from error
        await self._carried_out()
        return self._answer(shown, ended, replaced)

    def _answer(
        self, row: requests.BlockedHost, ended: requests.BlockEnded, replaced: requests.BlockedHost | None
    ) -> requests.HostBlocked:
        knows = self._policies.current.knows
        others = sorted(other for other in self._same_machine(row.address) if knows(address_of(other)))
        return requests.HostBlocked(**asdict(row), ended=ended, replaced=replaced, other_addresses=others)

    async def unblock(self, request: HostUnblock, who: str) -> requests.HostUnblocked:
        address = self._address(request.address)
        earlier = self._blocks.rows().get(address)
        if earlier is None:
            raise UnknownThingError(f"{address} is not blocked: `rosrv host blocks` lists the blocked hosts")
        take_effect()
        shown, restored = self._row(earlier), self._lift([address])
        self._trail.happened(
            "host unblocked",
            f"the block of {address} by {earlier.who} was lifted",
            host=earlier.address,
            whole=True,
            address=earlier.address,
            who=who,
            earlier=_words(earlier),
            restored=restored,
        )
        await self._store.until_settled()
        await self._carried_out()
        return requests.HostUnblocked(**asdict(shown), restored=restored)

    def _due(self, ended: list[str]) -> None:
        rows = self._blocks.rows()
        due = [address for address in map(address_of, ended) if address in rows]
        self._lift(due)
        for address in due:
            self._trail.happened(
                "host block ended",
                f"the block of {address} by {rows[address].who} is over",
                host=rows[address].address,
                whole=True,
                address=rows[address].address,
                earlier=_words(rows[address]),
                note=rows[address].note,
            )

    def _lift(self, addresses: Iterable[Address]) -> int:
        before = self._registrations()
        for address in addresses:
            self._blocks.take(address)
        self._policies.decide_again()
        return self._registrations() - before

    # --- what may be blocked ---

    def _address(self, text: str) -> Address:
        policy = self._policies.current
        enrolled = {name: address_of(address) for name, address in self._enrolled().items()}
        try:
            return HostNames.of(policy.text, enrolled, policy.robot).host(text)
        except UnknownHostNameError as error:
            raise SenselessError(str(error)) from None

    def _require_possible(self, address: Address) -> None:
        if address.is_unspecified or address.is_multicast or str(address) == "255.255.255.255":
            raise HostRefusedError(f"{address} cannot be the address of a host")
        if address.is_loopback or self._is_own(address):
            raise HostRefusedError(
                f"{address} is the appliance's own address: its own calls come from there, so it cannot be blocked"
            )

    def _require_not_the_robot(self, address: Address, held: requests.BlockEnded) -> None:
        own, whole = _registrations_of(held), self._registrations()
        if any(address in network for network in self._policies.current.robot):
            why = "is the robot's own host"
        elif own > max(whole / 2, _FEW):
            why = f"has {own} of {counted(whole, 'registration')}, so it may be the robot itself"
        else:
            return
        raise HostRefusedError(
            f"{address} {why}: blocking it would end {in_words(held)}; to block it anyway, use --force"
            " (REST: `force`)"
        )

    def _require_not_the_caller(self, address: Address) -> None:
        caller = caller_host()
        own = "" if not caller else str(plain_address(caller))
        if str(address) in {own, *self._same_machine(own)}:
            raise HostRefusedError(
                f"your own requests come from {address}: blocking it would end your way in; the admin socket (rosrv on"
                " the appliance) stays open. To block it anyway, use --force (REST: `force`)"
            )

    def _same_machine(self, address: str) -> set[str]:
        enrolled = self._enrolled()
        pairs = ({enrolled[name], remote} for name, remote in self._remotes().items() if name in enrolled)
        return {other for pair in pairs if address in pair for other in pair - {address}}

    # --- what a host has ---

    def _held_by(self, address: Address) -> requests.BlockEnded:
        count = Counter(_REGISTERED.get(one.call, "") for one in self._live() if one.host == address)
        connections = sum(str(address) in hosts for hosts in self._connected())
        tunnels = [
            f"the tunnel of {name}, from {remote}"
            for name, remote in self._remotes().items()
            if str(address) in {self._enrolled().get(name), remote}
        ]
        return requests.BlockEnded(
            **{name: count[name] for name in _REGISTERED.values()},
            connections=connections,
            uses=[*tunnels, *self._uses(address)],
        )

    def _registrations(self) -> int:
        return sum(one.call in _REGISTERED for one in self._live())

    def _row(self, row: HostBlockRow) -> requests.BlockedHost:
        names = (name for name, address in self._enrolled().items() if address == row.address)
        return requests.BlockedHost(
            row.address, next(names, ""), row.since, self._blocks.until(row), row.who, row.note
        )


def _require_sensible(request: HostBlock) -> None:
    if not request.note.isprintable():
        raise SenselessError("a note has only printable characters")


def is_own(address: Address) -> bool:
    """Return whether this machine has the address."""
    family = socket.AF_INET if address.version == 4 else socket.AF_INET6
    with socket.socket(family, socket.SOCK_DGRAM) as sock:
        try:
            sock.bind((str(address), 0))
        except OSError:
            return False
    return True


def _difference(before: requests.BlockEnded, after: requests.BlockEnded) -> requests.BlockEnded:
    left = asdict(after)
    numbers = {name: count for name, count in asdict(before).items() if isinstance(count, int)}
    return requests.BlockEnded(**{name: count - left[name] for name, count in numbers.items()})


def in_words(held: requests.BlockEnded) -> str:
    return f"{counted(_registrations_of(held), 'registration')} and {counted(held.connections, 'connection')}"


def _registrations_of(held: requests.BlockEnded) -> int:
    return held.publications + held.subscriptions + held.services + held.parameters


def _words(row: HostBlockRow) -> str:
    return f"blocked by {row.who}"
