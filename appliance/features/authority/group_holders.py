"""Keep the holder of each group, and the hosts that wait for it. No I/O; times are monotonic seconds.

1. `free` and `hold` are separate steps, so that the caller can cut the earlier holder off in between.
2. The first waiting host that may take the group is next. A host that may only ask never is, and gives its place to
   one that may take it if all are taken.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from appliance.policy.authority import AuthorityGroup, Claim
from appliance.policy.model import Address

WAITING_SECONDS = 60.0
MOST_WAITING = 16
ClaimOf = Callable[[AuthorityGroup, Address], Claim | None]


@dataclass(frozen=True, slots=True)
class Holding:
    """The host that holds a group."""

    host: Address
    since: float
    renewed: float
    """The time when the host last took the group again."""
    lost: bool = False
    """Whether a policy since then gave the host no claim; it loses the group at the next check."""
    had_node: bool = False
    """Whether the host has had a live node; otherwise the end of its nodes does not end the authority."""


class GroupHolders:
    """The holders and waiting hosts of all groups."""

    def __init__(self, claim_of: ClaimOf) -> None:
        self._claim_of = claim_of
        self._held: dict[str, Holding] = {}
        self._waiting: dict[str, dict[Address, float]] = {}

    def hosts(self) -> dict[str, Address]:
        return {group: holding.host for group, holding in self._held.items() if not holding.lost}

    def lose_claims(self, groups: Mapping[str, AuthorityGroup]) -> None:
        """Mark the holders without a claim; the groups that the policy no longer has lose theirs."""
        for name, holding in self._held.items():
            group = groups.get(name)
            if group is None or self._claim_of(group, holding.host) is None:
                self._held[name] = replace(holding, lost=True)

    def holder(self, group: str) -> Holding | None:
        return self._held.get(group)

    def waiting(self, group: AuthorityGroup, now: float) -> list[Address]:
        queue = self._waiting.get(group.name, {})
        left = {
            host: since
            for host, since in queue.items()
            if now - since < WAITING_SECONDS and self._claim_of(group, host) is not None
        }
        self._waiting[group.name] = left
        return list(left)

    def may_take(self, group: AuthorityGroup, host: Address) -> bool:
        claim, holding = self._claim_of(group, host), self._held.get(group.name)
        if holding is None or holding.host == host:
            return claim in (Claim.TAKE, Claim.OVERRIDE)
        return claim is Claim.OVERRIDE

    def wait(self, group: AuthorityGroup, host: Address, now: float) -> bool:
        waiting = self.waiting(group, now)
        if host not in waiting and len(waiting) >= MOST_WAITING:
            asking = [one for one in waiting if self._claim_of(group, one) is Claim.ASK]
            if not asking or self._claim_of(group, host) is Claim.ASK:
                return False
            del self._waiting[group.name][asking[-1]]
        self._waiting[group.name][host] = now
        return True

    def free(self, group: str) -> Holding | None:
        return self._held.pop(group, None)

    def hold(self, group: str, host: Address, now: float) -> None:
        before = self._held.get(group)
        if before is not None and before.host != host:
            raise ValueError(f"{group} is held by {before.host}: free it first")
        self._held[group] = Holding(host, now, now) if before is None else replace(before, renewed=now)
        self._waiting.get(group, {}).pop(host, None)

    def seconds_left(self, group: AuthorityGroup, now: float, moved: float) -> float | None:
        """Return the seconds until a silent holder loses the group.

        `moved` is the time of its last message to the group.
        """
        holding = self._held.get(group.name)
        return None if holding is None else max(holding.renewed, moved) + group.release_after - now

    def loss(self, group: AuthorityGroup, now: float, *, moved: float, live: bool) -> str:
        """Return why the holder loses the group, or an empty string. `live` is whether it has a live node."""
        holding = self._held.get(group.name)
        if holding is None:
            return ""
        if holding.lost or self._claim_of(group, holding.host) is None:
            return "the policy no longer lets it hold the group"
        if live and not holding.had_node:
            self._held[group.name] = replace(holding, had_node=True)
        if holding.had_node and not live:
            return "its nodes ended"
        left = self.seconds_left(group, now, moved)
        return f"it was silent for {group.release_after:g} s" if left is not None and left <= 0 else ""

    def successor(self, group: AuthorityGroup, now: float) -> Address | None:
        able = (Claim.TAKE, Claim.OVERRIDE)
        return next((host for host in self.waiting(group, now) if self._claim_of(group, host) in able), None)

    def forget_others(self, names: frozenset[str]) -> dict[str, Holding]:
        self._waiting = {name: queue for name, queue in self._waiting.items() if name in names}
        gone = {name: holding for name, holding in self._held.items() if name not in names}
        for name in gone:
            del self._held[name]
        return gone
