"""Limit a finite resource by host, so that no host can exhaust it.

`Pool` is arithmetic without I/O: it decides whether a host may have more, and counts its holdings. The owner of the
resource asks the pool before each allocation.

Invariants, for a pool with `Bounds(whole, host, strangers, kept)`:

1. All hosts together hold at most `whole`; one host at most `host`.
2. All strangers together hold at most `strangers`, however many addresses they have.
3. All hosts without a registration together hold at most `whole - kept`. The rest remains for the robot's own nodes,
   however many other hosts came first.
4. A host without holdings takes no memory.

A host's standing may change while it holds something. Each call for a host reads its present standing and moves its
holdings to it. No call checks other hosts.
"""

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Generic, TypeVar

Holder = TypeVar("Holder", bound=Hashable)


class Standing(IntEnum):
    """Rank a host by policy and registry; a host of higher rank is evicted later."""

    STRANGER = 0
    """No policy rule names its address."""

    NAMED = 1
    """A rule names its address, and it has no registration now."""

    REGISTERED = 2
    """It has a registration, or a relay grant, which only registered nodes get."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limit each share of a pool, in its unit. Raises ValueError if a part exceeds the whole."""

    whole: int
    """All hosts together."""

    host: int
    """One host."""

    strangers: int
    """All strangers together."""

    kept: int
    """The part of the whole for registered hosts only."""

    def __post_init__(self) -> None:
        if min(self.whole, self.host, self.strangers, self.kept) < 0:
            raise ValueError(f"{self} has a part below 0")
        if self.host > self.whole or self.strangers > self.whole - self.kept:
            raise ValueError(
                f"{self}: a host's share, or the strangers' with what is kept, is beyond the whole"
            )

    def sized(self, whole: int, host: int | None = None) -> "Bounds":
        """Return bounds for the operator's whole and share of a host (None: in proportion).

        The strangers' share and the kept part stay in proportion to the whole, rounded down. Strangers that had a share
        keep at least one, so that a small pool still gives them a reason for a refusal.
        """
        host = self.host * whole // self.whole if host is None else host
        strangers = self.strangers * whole // self.whole
        if self.strangers and not strangers:
            strangers = 1
        kept = min(self.kept * whole // self.whole, whole - strangers)
        return Bounds(whole, min(host, whole), strangers, kept)


class Pool(Generic[Holder]):
    """Count the holdings of each host in one finite resource.

    `what` is the noun of refusals, with its unit: "connections", "bytes of parameters". `strangers` is the noun for
    hosts with the standing of a stranger. `standing` returns the present standing of a host. For a machine with many
    addresses (IPv6), give its network as the host.
    """

    def __init__(
        self,
        what: str,
        bounds: Bounds,
        standing: Callable[[Holder], Standing],
        strangers: str = "addresses that no rule of the policy names",
    ) -> None:
        self.what = what
        self.strangers = strangers
        self.bounds = bounds
        self._standing = standing
        self._held: dict[Holder, tuple[Standing, int]] = {}
        self._by_standing = [0 for _ in Standing]

    def refusal(self, host: Holder, amount: int = 1) -> str:
        """Return why `host` may not have `amount` more; empty if it may."""
        return self._refusal(host, amount, *self._look_up(host))

    def _refusal(self, host: Holder, amount: int, standing: Standing, mine: int) -> str:
        bounds, what = self.bounds, self.what
        strangers, named, registered = self._by_standing
        if mine + amount > bounds.host:
            return f"{host} has {mine} {what}; the share of one host is {bounds.host}"
        if standing is Standing.STRANGER and strangers + amount > bounds.strangers:
            return f"{self.strangers} have {strangers} {what}; their share together is {bounds.strangers}"
        others = strangers + named
        if standing is not Standing.REGISTERED and others + amount > bounds.whole - bounds.kept:
            return (
                f"hosts without a registration have {others} {what}; "
                f"{bounds.kept} of {bounds.whole} are kept for those with one"
            )
        if others + registered + amount > bounds.whole:
            return f"all hosts together have {others + registered} {what}; the limit is {bounds.whole}"
        return ""

    def take(self, host: Holder, amount: int = 1) -> str:
        """Give `host` the whole amount or nothing. Return the reason as `refusal` does."""
        standing, mine = self._look_up(host)
        reason = self._refusal(host, amount, standing, mine)
        if not reason:
            self._set(host, standing, mine, mine + amount)
        return reason

    def charge(self, host: Holder, amount: int = 1) -> None:
        """Count an amount without a check: `host` has it already, or it can no longer be refused."""
        standing, mine = self._look_up(host)
        self._set(host, standing, mine, mine + amount)

    def give_back(self, host: Holder, amount: int = 1) -> None:
        """Take an amount from `host`. Raises ValueError if it has less."""
        standing, mine = self._look_up(host)
        if amount > mine:
            raise ValueError(f"{host} gives back {amount} {self.what} and has {mine}")
        self._set(host, standing, mine, mine - amount)

    def held(self, host: Holder) -> int:
        """Return the holdings of `host`."""
        return self._held.get(host, _NOTHING)[1]

    def held_by(self, standing: Standing) -> int:
        """Return the holdings of all hosts of this standing, as last counted."""
        return self._by_standing[standing]

    @property
    def total(self) -> int:
        """Return the holdings of all hosts."""
        return sum(self._by_standing)

    def holders(self) -> Iterator[tuple[Holder, int]]:
        """Yield every host with holdings, and their amount."""
        return ((host, amount) for host, (_, amount) in self._held.items())

    def _look_up(self, host: Holder) -> tuple[Standing, int]:
        """Return the present standing and holdings of a host; count them under that standing."""
        standing = self._standing(host)
        counted_as, amount = self._held.get(host, _NOTHING)
        if amount and counted_as is not standing:
            self._by_standing[counted_as] -= amount
            self._set(host, standing, 0, amount)
        return standing, amount

    def _set(self, host: Holder, standing: Standing, before: int, amount: int) -> None:
        """Change the holdings of a host from `before` to `amount`, both under this standing."""
        self._by_standing[standing] += amount - before
        if amount:
            self._held[host] = standing, amount
        elif before:
            del self._held[host]


_NOTHING = (Standing.STRANGER, 0)
