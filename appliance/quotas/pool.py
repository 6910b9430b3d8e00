"""Limit a finite resource by host, so that no host can exhaust the resource. No I/O.

1. All unknown hosts together hold at most `unknown`, however many addresses they have.
2. All hosts without a registration together hold at most `whole - kept`.
3. With a `share`, each of *n* greedy hosts leaves something for the next one.
4. The pool stores nothing about a host without holdings.

Each call for a host counts its holdings under its present class. Other hosts are not checked.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Generic, TypeVar

Holder = TypeVar("Holder", bound=Hashable)
Member = TypeVar("Member")
_MAX_MOVED = 64  # the most members that one search moves to the present quota class of their hosts


class QuotaClass(IntEnum):
    """The rank of a host by policy and registry; a host of higher rank is evicted later."""

    UNKNOWN = 0
    """No policy rule names the host's address."""

    NAMED = 1
    """A policy rule names the host's address, but the host has no registration now."""

    REGISTERED = 2
    """The host has a registration, or a relay grant. Only registered nodes get relay grants."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """The limits of a pool, in its unit. Raises ValueError if a part exceeds the whole."""

    whole: int
    """The limit of all hosts together."""

    host: int
    """The limit of one host."""

    unknown: int
    """The limit of all unknown hosts together."""

    kept: int
    """The part of `whole` that is reserved for registered hosts."""

    share: int = 0
    """A host gets one, and further ones up to this many times what it leaves for all others; 0: up to `host`."""

    def __post_init__(self) -> None:
        if min(self.whole, self.host, self.unknown, self.kept) < 0:
            raise ValueError(f"{self} has a part below 0")
        if self.host > self.whole or self.unknown > self.whole - self.kept:
            raise ValueError(
                f"{self}: the quota of a host, or of unknown hosts and the kept part together, exceeds the whole"
            )

    def resize(self, whole: int, host: int | None = None) -> "Bounds":
        """Return bounds with the operator's `whole` and `host` (None: scaled with `whole`).

        A nonzero `unknown` stays at least one, so that a small pool can still tell an unknown host the reason of a
        refusal.
        """
        host = self.host * whole // self.whole if host is None else host
        unknown = self.unknown * whole // self.whole
        if self.unknown and not unknown:
            unknown = 1
        kept = min(self.kept * whole // self.whole, whole - unknown)
        return Bounds(whole, min(host, whole), unknown, kept, self.share)

    def share_refusal(self, host: object, mine: int, total: int, what: str) -> str:
        """Return the reason why `host` may not have `mine` of then `total`; empty if its share allows it."""
        left = self.whole - total
        if not self.share or mine <= max(1, self.share * left):
            return ""
        most = f"at most {'' if self.share == 1 else f'{self.share} times '}as many as it leaves"
        return f"{host} would use {mine} {what}, leaving {left} for all others; a host may use {most}"


class Pool(Generic[Holder]):
    """The holdings of each host in one finite resource; its owner asks before each allocation.

    In refusals, `what` is the name of the resource with its unit, and `unknown` that of unknown hosts. For a machine
    with many IPv6 addresses, pass its network as the host.
    """

    def __init__(
        self,
        what: str,
        bounds: Bounds,
        quota_class: Callable[[Holder], QuotaClass],
        unknown: str = "addresses that no rule of the policy names",
    ) -> None:
        self.what = what
        self.unknown = unknown
        self.bounds = bounds
        self._quota_class = quota_class
        self._held: dict[Holder, tuple[QuotaClass, int]] = {}
        self._by_class = [0 for _ in QuotaClass]

    def refusal(self, host: Holder, amount: int = 1) -> str:
        """Return the reason of a refusal; empty if `host` may have `amount` more."""
        return self._refusal(host, amount, *self._look_up(host))

    def _refusal(self, host: Holder, amount: int, quota_class: QuotaClass, mine: int) -> str:
        bounds, what = self.bounds, self.what
        unknown, named, registered = self._by_class
        if mine + amount > bounds.host:
            return f"{host} has {mine} {what}; the quota of one host is {bounds.host}"
        if quota_class is QuotaClass.UNKNOWN and unknown + amount > bounds.unknown:
            return f"{self.unknown} have {unknown} {what}; their quota together is {bounds.unknown}"
        others, total = unknown + named, unknown + named + registered + amount
        if quota_class is not QuotaClass.REGISTERED and others + amount > bounds.whole - bounds.kept:
            return (
                f"hosts without a registration have {others} {what}; "
                f"{bounds.kept} of {bounds.whole} are kept for those with one"
            )
        if total > bounds.whole:
            return f"all hosts together have {total - amount} {what}; the limit is {bounds.whole}"
        return bounds.share_refusal(host, mine + amount, total, what)

    def take(self, host: Holder, amount: int = 1) -> str:
        quota_class, mine = self._look_up(host)
        reason = self._refusal(host, amount, quota_class, mine)
        if not reason:
            self._set(host, quota_class, mine, mine + amount)
        return reason

    def charge(self, host: Holder, amount: int = 1) -> None:
        """Count an amount without a check: `host` already has it or can no longer be refused."""
        quota_class, mine = self._look_up(host)
        self._set(host, quota_class, mine, mine + amount)

    def give_back(self, host: Holder, amount: int = 1) -> None:
        quota_class, mine = self._look_up(host)
        if amount > mine:
            raise ValueError(f"{host} returns {amount} {self.what} and has {mine}")
        self._set(host, quota_class, mine, mine - amount)

    def held(self, host: Holder) -> int:
        return self._held.get(host, _NOTHING)[1]

    def held_by(self, quota_class: QuotaClass) -> int:
        """Return the holdings of a class, by the class of each host when it was last counted."""
        return self._by_class[quota_class]

    @property
    def total(self) -> int:
        return sum(self._by_class)

    def holders(self) -> Iterator[tuple[Holder, int]]:
        return ((host, amount) for host, (_, amount) in self._held.items())

    def _look_up(self, host: Holder) -> tuple[QuotaClass, int]:
        quota_class = self._quota_class(host)
        counted_as, amount = self._held.get(host, _NOTHING)
        if amount and counted_as is not quota_class:
            self._by_class[counted_as] -= amount
            self._set(host, quota_class, 0, amount)
        return quota_class, amount

    def _set(self, host: Holder, quota_class: QuotaClass, before: int, amount: int) -> None:
        self._by_class[quota_class] += amount - before
        if amount:
            self._held[host] = quota_class, amount
        elif before:
            del self._held[host]


_NOTHING = (QuotaClass.UNKNOWN, 0)


class Queue(Generic[Holder, Member]):
    """Members of hosts in order of insertion."""

    def __init__(self, quota_class: Callable[[Holder], QuotaClass]) -> None:
        self._quota_class = quota_class
        self._lines = {level: OrderedDict[Member, tuple[Holder, float]]() for level in QuotaClass}
        self._line_of: dict[Member, OrderedDict[Member, tuple[Holder, float]]] = {}

    def put(self, member: Member, host: Holder, since: float) -> None:
        self._file(member, host, since, self._quota_class(host))

    def remove(self, member: Member) -> bool:
        line = self._line_of.pop(member, None)
        if line is None:
            return False
        del line[member]
        return True

    def longest(self, quota_class: QuotaClass) -> tuple[Member, Holder, float] | None:
        for _ in range(_MAX_MOVED):
            found = next(iter(self._lines[quota_class].items()), None)
            if found is None:
                break
            member, (host, since) = found
            now = self._quota_class(host)
            if now is quota_class:
                return member, host, since
            self._file(member, host, since, now)
        return None

    def of_host(self, host: Holder) -> list[Member]:
        return [
            member for line in self._lines.values() for member, (owner, _) in line.items() if owner == host
        ]

    def __iter__(self) -> Iterator[Member]:
        return iter(list(self._line_of))

    def _file(self, member: Member, host: Holder, since: float, quota_class: QuotaClass) -> None:
        before = self._line_of.get(member)
        if before is not None:
            del before[member]
        line = self._lines[quota_class]
        line[member] = host, since
        self._line_of[member] = line
