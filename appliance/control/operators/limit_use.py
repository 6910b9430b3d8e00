"""Collect how much of each finite resource is used. docs/reference/generated/quotas.md has all quotas."""

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec

from appliance.channel.answers.limit_answers import LimitUse
from appliance.configuration.settings import Settings
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.registry import Registry
from appliance.policy.host_sets import Network
from appliance.policy.model import Address
from appliance.quotas.pool import Pool, QuotaClass
from appliance.quotas.table import NAMES, RELAY_FRAMES, RELAY_LATCHED, RELAY_QUEUES, QuotaRow

Holder = TypeVar("Holder")


@dataclass(frozen=True)
class OwnUses:
    """Yields the use of each resource of the core, for `rosrv limits`; features add their own."""

    registry: Registry
    carried: RelayTraffic
    ports: Callable[[], Pool[Network]]
    connected: Pool[Address]
    parameters: Pool[Address]
    settings: Settings

    def __call__(self) -> Iterator[LimitUse]:
        yield from (*self._registry(), *self._pools(), *self._relays(), *self._stored())

    def _registry(self) -> Iterator[LimitUse]:
        limits = self.settings.limits
        nodes = Counter(one.host for one in self.registry.all() if not one.own)
        yield _by_host("nodes", None, "limits.nodes_per_host", nodes, limits.nodes_per_host)
        yield _by_host(
            "registrations",
            NAMES.bounds.whole,
            "limits.topics_per_host",
            dict(self.registry.registrations_by_host()),
            limits.topics_per_host,
        )

    def _pools(self) -> Iterator[LimitUse]:
        yield of_pool("ports of nodes", "[Ports] range", self.ports())
        yield of_pool("connections to RVMaster and nodes", "limits.connections", self.connected)
        yield of_pool("bytes of parameters", "limits.parameter_bytes", self.parameters)

    def _relays(self) -> Iterator[LimitUse]:
        carried, limits = self.carried, self.settings.relay
        allowed = limits.connections * self.settings.relays
        yield LimitUse("connections to the relays", len(carried.connections), allowed, "relay.connections")
        for kind, (resource, row) in _MEMORY.items():
            fullest = max((held.get(kind, 0) for held in carried.memory.values()), default=0)
            allowed = row.bounds.whole * int(limits.memory_bytes) // _WHOLE_MEMORY
            yield LimitUse(f"{resource}, one relay", fullest, allowed, "relay.memory_bytes")

    def _stored(self) -> Iterator[LimitUse]:
        audit, folder = self.settings.audit, self.settings.state / "control"
        size = sum(map(_size, folder.glob("audit.db*")))
        kept = None if audit.retention_bytes is None else int(audit.retention_bytes)
        allowed = size + shutil.disk_usage(folder).free if kept is None else kept
        yield LimitUse("bytes of audit records", size, allowed, "audit.retention_bytes, or the disk")


_MEMORY: dict[str, tuple[str, QuotaRow]] = {
    "frames": ("bytes of unfinished messages", RELAY_FRAMES),
    "queues": ("bytes waiting for subscribers", RELAY_QUEUES),
    "latched": ("bytes of latched messages", RELAY_LATCHED),
}
"""The parts of a relay's memory. The answer shows the relay that holds most of each."""

_WHOLE_MEMORY = sum(row.bounds.whole for _resource, row in _MEMORY.values())  # as `RelayMemory.of` divides it


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except FileNotFoundError:  # SQLite removed its write-ahead log in the meantime
        return 0


def _by_host(
    resource: str, whole: int | None, setting: str, held: Mapping[Holder, int], allowed: int
) -> LimitUse:
    host = max(held, key=lambda one: held[one], default=None)
    used = sum(held.values())
    if host is None:
        return LimitUse(resource, used, whole, setting)
    name = str(host).removesuffix("/32").removesuffix("/128")  # a pool may name a host as a network
    return LimitUse(resource, used, whole, setting, name, held[host], allowed)


def of_pool(resource: str, setting: str, pool: Pool[Holder]) -> LimitUse:
    """Return the use of a pool, with the host, or the hosts with one limit together, that are nearest to a limit."""
    bounds, unknown = pool.bounds, pool.held_by(QuotaClass.UNKNOWN)
    row = _by_host(resource, bounds.whole, setting, dict(pool.holders()), bounds.host)
    unregistered = unknown + pool.held_by(QuotaClass.NAMED), bounds.whole - bounds.kept
    together = ((pool.unknown, unknown, bounds.unknown), ("hosts without a registration", *unregistered))
    for holders, used, allowed in together:
        if used * row.host_allowed > row.host_used * allowed:
            row = msgspec.structs.replace(row, host=holders, host_used=used, host_allowed=allowed)
    return row
