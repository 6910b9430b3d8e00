"""A finite thing, counted by host, so that nobody can use up what others need.

`Pool` is arithmetic without I/O: it says whether a host may have more, and keeps count of what it has. Whoever owns
the thing asks before it gives.

Invariants, for a pool with `Bounds(whole, host, strangers, kept)`:

1. All hosts together hold at most `whole`; one host at most `host`.
2. All strangers together hold at most `strangers`, however many addresses they have.
3. All hosts without a registration together hold at most `whole - kept`: so much is there for the robot's own nodes
   when everybody else has come first.
4. Who holds nothing takes no memory.

A host's standing may change while it holds something. It is looked up again at each call for that host, and what the
host holds moves with it; no call looks at other hosts.
"""

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Generic, TypeVar

Holder = TypeVar("Holder", bound=Hashable)


class Standing(IntEnum):
    """What the policy and the registry know of a host; a higher one makes room later."""

    STRANGER = 0
    """No rule of the policy names its address."""

    NAMED = 1
    """A rule names its address; it has no registration now."""

    REGISTERED = 2
    """It has a registration, or what only a registered node can have (a grant of the relay)."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """How much of a pool each may hold, in the unit of the pool. Raises ValueError where a part is beyond the whole."""

    whole: int
    """All hosts together."""

    host: int
    """One host."""

    strangers: int
    """All strangers together."""

    kept: int
    """Of the whole, what only registered hosts may hold."""

    def __post_init__(self) -> None:
        if min(self.whole, self.host, self.strangers, self.kept) < 0:
            raise ValueError(f"{self} has a part below 0")
        if self.host > self.whole or self.strangers > self.whole - self.kept:
            raise ValueError(
                f"{self}: a host's share, or the strangers' with what is kept, is beyond the whole"
            )

    def sized(self, whole: int, host: int | None = None) -> "Bounds":
        """With another whole and another share of a host (None: the same part), as an operator has set them.

        The strangers' share and what is kept are the same parts of the whole as before, rounded down; one at least for
        strangers that had a share, so that a small pool turns nobody away who is told why.
        """
        host = self.host * whole // self.whole if host is None else host
        strangers = self.strangers * whole // self.whole
        if self.strangers and not strangers:
            strangers = 1
        kept = min(self.kept * whole // self.whole, whole - strangers)
        return Bounds(whole, min(host, whole), strangers, kept)


class Pool(Generic[Holder]):
    """Counts what each host holds of one finite thing.

    `what` is the noun of refusals, with its unit: "connections", "bytes of parameters". `standing` says what is known
    of a host now; a machine that may have many addresses (IPv6) is one holder if its network is given as the host.
    """

    def __init__(self, what: str, bounds: Bounds, standing: Callable[[Holder], Standing]) -> None:
        self.what = what
        self.bounds = bounds
        self._standing = standing
        self._held: dict[Holder, tuple[Standing, int]] = {}
        self._by_standing = [0 for _ in Standing]

    def refusal(self, host: Holder, amount: int = 1) -> str:
        """Why `host` may not have `amount` more, in words; empty when it may."""
        return self._refusal(host, amount, *self._look_up(host))

    def _refusal(self, host: Holder, amount: int, standing: Standing, mine: int) -> str:
        bounds, what = self.bounds, self.what
        strangers, named, registered = self._by_standing
        if mine + amount > bounds.host:
            return f"{host} has {mine} {what}; the share of one host is {bounds.host}"
        if standing is Standing.STRANGER and strangers + amount > bounds.strangers:
            return (
                f"addresses that no rule of the policy names have {strangers} {what}; "
                f"their share together is {bounds.strangers}"
            )
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
        """Give `host` so much if it may have it; else nothing is given. Returns the reason as `refusal` does."""
        standing, mine = self._look_up(host)
        reason = self._refusal(host, amount, standing, mine)
        if not reason:
            self._set(host, standing, mine, mine + amount)
        return reason

    def charge(self, host: Holder, amount: int = 1) -> None:
        """Count what `host` has, without asking: what it has already, or what cannot be refused any more."""
        standing, mine = self._look_up(host)
        self._set(host, standing, mine, mine + amount)

    def give_back(self, host: Holder, amount: int = 1) -> None:
        """`host` has so much less. Raises ValueError when that is more than it has."""
        standing, mine = self._look_up(host)
        if amount > mine:
            raise ValueError(f"{host} gives back {amount} {self.what} and has {mine}")
        self._set(host, standing, mine, mine - amount)

    def held(self, host: Holder) -> int:
        """What `host` has."""
        return self._held.get(host, _NOTHING)[1]

    def held_by(self, standing: Standing) -> int:
        """What hosts of this standing have, each as it was counted last."""
        return self._by_standing[standing]

    @property
    def total(self) -> int:
        """What all hosts have."""
        return sum(self._by_standing)

    def holders(self) -> Iterator[tuple[Holder, int]]:
        """Every host that holds something, and how much."""
        return ((host, amount) for host, (_, amount) in self._held.items())

    def _look_up(self, host: Holder) -> tuple[Standing, int]:
        """The host's standing now, and what it has; what it has is counted under that standing from now on."""
        standing = self._standing(host)
        counted_as, amount = self._held.get(host, _NOTHING)
        if amount and counted_as is not standing:
            self._by_standing[counted_as] -= amount
            self._set(host, standing, 0, amount)
        return standing, amount

    def _set(self, host: Holder, standing: Standing, before: int, amount: int) -> None:
        """The host has `amount`, and had `before`, both counted under this standing."""
        self._by_standing[standing] += amount - before
        if amount:
            self._held[host] = standing, amount
        elif before:
            del self._held[host]


_NOTHING = (Standing.STRANGER, 0)
