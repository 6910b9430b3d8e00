"""Hand groups of `[Authority]` over: operators order it, nodes call for it, and silent holders lose it.

The earlier holder is cut off on every relay before the next host holds the group. Nothing is stored: after a restart
or a takeover, each group is free.
"""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from weakref import WeakValueDictionary

from appliance.base import clock
from appliance.base.withdrawal import take_effect
from appliance.channel.messages import OwnServiceAnswered, OwnServiceCalled
from appliance.control.errors import SenselessError, UnavailableError, UnknownThingError
from appliance.control.motion_stop import StopAfter
from appliance.features.authority import requests
from appliance.features.authority.ranked_groups import RankedGroups
from appliance.features.authority.view import AuthorityState, NotCarried, UnheardGroup
from appliance.master.endpoints.host_signs import HostSigns
from appliance.policy.authority import AuthorityGroup, Claim
from appliance.policy.host_names import HostNames, UnknownHostNameError
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.telemetry.audit_trail import AuditTrail

# Keep the holder of each group, and the hosts that wait for it. No I/O; times are monotonic seconds.
#
# 1. `free` and `hold` are separate steps, so that the caller can cut the earlier holder off in between.
# 2. The first waiting host that may take the group is next. A host that may only ask never is, and gives its place to
#    one that may take it if all are taken. Otherwise the policy's host with the most waiting addresses gives one up.

WAITING_SECONDS = 60.0
MAX_WAITING = 16
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
    has_node: bool = False
    """Whether the host had a live node at the last check."""
    moved: float = 0.0
    """The time of its last message to the group, also of a node that has ended since."""


class GroupHolders:
    """The holders and waiting hosts of all groups."""

    def __init__(self, claim_of: ClaimOf, share_of: Callable[[Address], str] = str) -> None:
        self._claim_of = claim_of
        self._share_of = share_of
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
        if host not in waiting and len(waiting) >= MAX_WAITING:
            asks = self._claim_of(group, host) is Claim.ASK
            asking = [one for one in waiting if self._claim_of(group, one) is Claim.ASK]
            out = (
                asking[-1]
                if asking and not asks
                else self._beyond_its_share(asking if asks else waiting, host)
            )
            if out is None:
                return False
            del self._waiting[group.name][out]
        self._waiting[group.name][host] = now
        return True

    def _beyond_its_share(self, waiting: list[Address], host: Address) -> Address | None:
        """Return the last address of the policy's host that has the most, if another one has fewer even with `host`."""
        shares = Counter(map(self._share_of, waiting))
        most, number = max(shares.items(), key=lambda item: item[1], default=("", 0))
        if shares[self._share_of(host)] + 1 >= number:
            return None
        return next(one for one in reversed(waiting) if self._share_of(one) == most)

    def free(self, group: str) -> Holding | None:
        return self._held.pop(group, None)

    def hold(self, group: str, host: Address, now: float) -> None:
        before = self._held.get(group)
        if before is not None and before.host != host:
            raise ValueError(f"{group} is held by {before.host}: free it first")
        self._held[group] = Holding(host, now, now) if before is None else replace(before, renewed=now)
        self._waiting.get(group, {}).pop(host, None)

    def seconds_left(
        self, group: AuthorityGroup, moved: float, silence: Callable[[float], float]
    ) -> float | None:
        """Return the seconds until a silent holder loses the group.

        `moved` is the time of its last message to the group, `silence(since)` the seconds of its silence after a time.
        """
        holding = self._held.get(group.name)
        if holding is None:
            return None
        return group.release_after - silence(max(holding.renewed, holding.moved, moved))

    def lost_nodes(self, group: str, *, live: bool) -> bool:
        """Return whether the holder had a live node until now. It keeps the group for a node that comes back."""
        holding = self._held.get(group)
        if holding is None:
            return False
        self._held[group] = replace(holding, has_node=live)
        return holding.has_node and not live

    def loss(self, group: AuthorityGroup, moved: float, silence: Callable[[float], float]) -> str:
        """Return why the holder loses the group, or an empty string."""
        holding = self._held.get(group.name)
        if holding is None:
            return ""
        if holding.lost or self._claim_of(group, holding.host) is None:
            return "the policy no longer lets it hold the group"
        self._held[group.name] = replace(holding, moved=max(moved, holding.moved))
        left = self.seconds_left(group, moved, silence)
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


CHECK_SECONDS = 0.25
_MAX_NAMED = 20  # hosts without an effect


class DriveOrders:
    """Answers operators and nodes. Requests raise `SenselessError`, `UnavailableError` or `UnknownThingError`.

    Each group has its own lock, so a hanging relay delays no other group.
    """

    def __init__(
        self,
        policy: Callable[[], Policy],
        trail: AuditTrail,
        signs: HostSigns,
        stop: StopAfter,
        ranked: RankedGroups,
        *,
        decide_again: Callable[[], int],
        # Waits until the relays of these topics (None: all relays) have applied the policy.
        carried_out: Callable[[Iterable[str] | None], Awaitable[None]],
        relays_ready: Callable[[], bool],
    ) -> None:
        self._policy = policy
        self._trail = trail
        self._signs = signs
        self._stop = stop
        self._ranked = ranked
        self._decide_again = decide_again
        self._carried_out = carried_out
        self._relays_ready = relays_ready
        self._groups = GroupHolders(self._claim, lambda host: self._policy().counted_as(host))
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    def holders(self) -> dict[str, Address]:
        return self._groups.hosts()

    def policy_changed(self) -> None:
        self._groups.lose_claims(self._held_groups())
        self._ranked.policy_changed()

    # --- operators ---

    async def status(self, _request: requests.DriveStatus) -> requests.GroupStates:
        groups = self._policy().authority
        return requests.GroupStates([self._state(groups[name]) for name in sorted(groups)])

    async def take(self, request: requests.DriveTake, who: str) -> requests.GroupState:
        group, host = self._held_group(request.group), self._host(request.host)
        async with self._turn(group):
            self._require_holder(group, request.holder)
            await self._taken(group, host, who)
        return self._state(group)

    async def give(self, request: requests.DriveGive, who: str) -> requests.GroupState:
        group = self._group(request.group)
        if group.ranks and not request.to:
            await self._ranked.free(group, who)
            return self._state(group)
        group = self._held_group(request.group)
        to = self._host(request.to) if request.to else None
        if to is not None and self._claim(group, to) is None:
            raise SenselessError(
                f"{to} has no claim to {group.name}: add it to the line `ask {group.name}` in [Authority]"
            )
        async with self._turn(group):
            self._require_holder(group, request.holder)
            if self._groups.holder(group.name) is None and to is None:
                return self._state(group)  # free already
            await self._hand_over(group, to, f"given by {who}", who)
        return self._state(group)

    async def ask(self, request: requests.DriveAsk, who: str) -> requests.GroupState:
        """Let a host wait for a group, or give it the group at once if it is free and the host may take it."""
        group, host = self._held_group(request.group), self._host(request.host)
        async with self._turn(group):
            await self._asked(group, host, who)
        return self._state(group)

    def _require_holder(self, group: AuthorityGroup, seen: str | None) -> None:
        """Raise `SenselessError` if the order is meant for another holder than the present one."""
        holding = self._groups.holder(group.name)
        now = "" if holding is None else str(holding.host)
        if seen is not None and seen != now:
            raise SenselessError(
                f"{group.name} was handed over in the meantime: {now or 'no host'} holds it, not {seen or 'no host'}."
                " Nothing was changed; look again before you order"
            )

    # --- nodes ---

    async def take_called(self, call: OwnServiceCalled) -> OwnServiceAnswered:
        host, done, refused = address_of(call.host), [], []
        for group in self._held_groups().values():
            claim = self._claim(group, host)
            if claim is None:
                continue
            try:
                async with self._turn(group):
                    if claim is Claim.ASK:
                        await self._asked(group, host, call.caller_id)
                    else:
                        await self._taken(group, host, call.caller_id)
                    if self._holds(group, host):
                        done.append(group.name)
                    else:
                        refused.append(f"{group.name}: asked for it")
            except (SenselessError, UnavailableError) as error:
                refused.append(str(error))
        if not done and not refused:
            refused.append(f"{host} has no claim to a group of [Authority]")
        text = "; ".join([*([f"{host} holds {', '.join(done)}"] if done else []), *refused])
        return OwnServiceAnswered(call.number, bool(done) and not refused, text, repeats=False)

    async def give_called(self, call: OwnServiceCalled) -> OwnServiceAnswered:
        host, done = address_of(call.host), []
        for group in self._held_groups().values():
            async with self._turn(group):
                holding = self._groups.holder(group.name)
                if holding is not None and holding.host == host:
                    await self._hand_over(group, None, f"given by {call.caller_id}", call.caller_id)
                    done.append(group.name)
        text = f"{host} gave {', '.join(done)}" if done else f"{host} holds no group"
        return OwnServiceAnswered(call.number, bool(done), text, repeats=False)

    # --- the end of a holding ---

    async def watch(self) -> None:
        async with asyncio.TaskGroup() as checks:
            while True:
                checks.create_task(self.check())
                await asyncio.sleep(CHECK_SECONDS)

    async def check(self) -> None:
        """Free each group whose holder was silent for too long; all of them before the first wait for a relay."""
        groups = self._held_groups()
        if gone := self._groups.forget_others(frozenset(groups)):
            self._decide_again()
        for name, holding in gone.items():
            self._record(name, holding, None, "the policy no longer has the group", "")
        await asyncio.gather(*map(self._check_group, groups.values()))

    async def _check_group(self, group: AuthorityGroup) -> None:
        turn = self._turn(group)
        if turn.locked():
            return  # a hand-over is under way
        async with turn:
            held = self._groups.holder(group.name)
            if held is None:
                if self._next(group) is not None:
                    await self._hand_over(group, None, "it waited for the group", "")
                return
            ended = self._groups.lost_nodes(group.name, live=self._signs.live(held.host))
            if loss := self._groups.loss(group, *self._quiet(group, held)):
                await self._hand_over(group, None, loss, "", stop=True)
            elif ended:
                await self._stop(str(held.host), group.names, f"{group.name}: its nodes ended")

    def _quiet(self, group: AuthorityGroup, held: Holding) -> tuple[float, Callable[[float], float]]:
        """Return the time of the holder's last message, and what returns its silence since a time."""
        about = held.host, group.names
        return self._signs.moved(*about), partial(self._signs.silence, *about)

    def _turn(self, group: AuthorityGroup) -> asyncio.Lock:
        return self._turns.setdefault(group.name, asyncio.Lock())

    # --- inside; the caller has the turn ---

    async def _taken(self, group: AuthorityGroup, host: Address, who: str) -> None:
        holding = self._groups.holder(group.name)
        if not self._groups.may_take(group, host):
            raise SenselessError(self._refusal(group, host, holding, who))
        take_effect()  # it waited for its turn
        if self._holds(group, host):
            self._groups.hold(group.name, host, clock.now())
            return
        reason = "taken" if holding is None else f"{host} may override its holder"
        await self._hand_over(group, host, reason, who)

    async def _asked(self, group: AuthorityGroup, host: Address, who: str) -> None:
        if self._claim(group, host) is None:
            raise SenselessError(self._refusal(group, host, None, who))
        take_effect()
        if self._holds(group, host):  # else the end of its own holding would give it the group again
            self._groups.hold(group.name, host, clock.now())
            return
        if self._groups.holder(group.name) is None and self._groups.may_take(group, host):
            await self._hand_over(group, host, "asked while no host held it", who)
            return
        if not self._groups.wait(group, host, clock.now()):
            raise UnavailableError(f"too many hosts wait for {group.name}: ask again later")
        self._trail.happened(
            "authority asked", f"{host} waits for {group.name}", host=str(host), resource=group.name, who=who
        )

    async def _hand_over(
        self, group: AuthorityGroup, to: Address | None, reason: str, who: str, *, stop: bool = False
    ) -> None:
        """Cut the holder off on all relays, then let the next host hold the group, and record both as one event.

        Without `to`, the first waiting host that may take the group is next. With `stop`, the group's guards stop the
        robot in between. If a relay is still not ready at the end, the group stays free.
        """
        if to is not None and not self._relays_ready():
            raise UnavailableError(f"a relay is starting, so {group.name} cannot be handed over: try again")
        take_effect()
        before = self._groups.free(group.name)
        try:
            if before is not None:
                self._decide_again()
                if stop:
                    await self._carried_out(group.names)
                    await self._stop(str(before.host), group.names, f"{group.name}: {reason}")
                await self._carried_out(None)  # all: a topic of the group may have moved between relays
            heir = to or self._next(group)
            # A relay whose link was lost in the meantime may still let the earlier holder through.
            if heir is not None and self._relays_ready() and self._claim(group, heir) is not None:
                self._groups.hold(group.name, heir, clock.now())
                self._decide_again()
                await self._carried_out(None)
        finally:
            now = self._groups.holder(group.name)
            if (before, now) != (None, None):
                self._record(group.name, before, now, reason, who)
        if to is not None and now is None:
            raise UnavailableError(
                f"{group.name} is free: a relay or the policy changed while it was handed over: try again"
            )

    def _record(self, group: str, before: Holding | None, now: Holding | None, reason: str, who: str) -> None:
        earlier, later = (("nobody" if one is None else str(one.host)) for one in (before, now))
        self._trail.happened(
            "authority handed over",
            f"{group}: from {earlier} to {later}: {reason}",
            host=later if now is not None else earlier if before is not None else None,
            resource=group,
            whole=True,
            earlier=earlier,
            holder=later,
            who=who,
        )

    def _refusal(self, group: AuthorityGroup, host: Address, holding: Holding | None, who: str) -> str:
        claim = self._claim(group, host)
        if holding is not None and claim is Claim.TAKE:
            reason = (
                f"{holding.host} holds {group.name}: `rosrv drive ask {group.name} --host {host}`, or wait until it is"
                " free"
            )
        elif claim is Claim.ASK:
            reason = (
                f"{host} may only ask for {group.name}: an operator assigns it with `rosrv drive free {group.name} --to"
                f" {host}`"
            )
        else:
            reason = f"{host} has no claim to {group.name}: no line of [Authority] names it ({group.rule})"
        self._trail.happened(
            "authority refused", reason, host=str(host), resource=group.name, decision="deny", who=who
        )
        return reason

    def _holds(self, group: AuthorityGroup, host: Address) -> bool:
        holding = self._groups.holder(group.name)
        return holding is not None and holding.host == host and not holding.lost

    def _next(self, group: AuthorityGroup) -> Address | None:
        return self._groups.successor(group, clock.now())

    def _claim(self, group: AuthorityGroup, host: Address) -> Claim | None:
        policy = self._policy()
        current = policy.authority.get(group.name)
        if current is None or policy.block_of(host) is not None:
            return None
        return current.claim(policy.atoms_of(host))

    def _held_groups(self) -> dict[str, AuthorityGroup]:
        """Return the groups without a rank."""
        return {name: group for name, group in self._policy().authority.items() if not group.ranks}

    def _held_group(self, name: str) -> AuthorityGroup:
        group = self._group(name)
        if group.ranks:
            raise SenselessError(
                f"{name} has a rank, so no order gives it to a host: the highest node that moves drives. After a loss,"
                f" `rosrv drive free {name}` hands it back"
            )
        return group

    def _group(self, name: str) -> AuthorityGroup:
        group = self._policy().authority.get(name)
        if group is None:
            known = ", ".join(sorted(self._policy().authority))
            others = f"its groups: {known}" if known else "add groups to the policy's section [Authority]"
            raise UnknownThingError(f"[Authority] has no group {name[:64]!r}; {others}")
        return group

    def _host(self, text: str) -> Address:
        policy = self._policy()
        try:
            return HostNames.of(policy.text, policy.enrolled, policy.robot).host(text)
        except UnknownHostNameError as error:
            raise SenselessError(str(error)) from None

    def _state(self, group: AuthorityGroup) -> requests.GroupState:
        if group.ranks:
            return self._ranked_state(group)
        now, holding = clock.now(), self._groups.holder(group.name)
        left = None if holding is None else self._groups.seconds_left(group, *self._quiet(group, holding))
        return requests.GroupState(
            group.name,
            sorted(group.names),
            "" if holding is None else str(holding.host),
            None if holding is None else round(now - holding.since, 1),
            group.release_after,
            None if left is None else round(max(0.0, left), 1),
            [str(host) for host in self._groups.waiting(group, now)],
            not_carried=self._not_carried(group),
        )

    def _not_carried(self, group: AuthorityGroup) -> list[NotCarried]:
        """Return the hosts that publish to the group while nothing of theirs is carried."""
        policy, found = self._policy(), dict[tuple[str, Address], list[str]]()
        for topic in sorted(group.names):
            for host, node in self._signs.publishers(topic):
                if not (
                    self._ranked.hears(group, host, node) if group.ranks else policy.may_command(topic, host)
                ):
                    found.setdefault((topic, host), []).append(node)
        return [
            NotCarried(str(host), topic, sorted(nodes), self._order(group, host))
            for (topic, host), nodes in list(found.items())[:_MAX_NAMED]
        ]

    def _order(self, group: AuthorityGroup, host: Address) -> str:
        if group.ranks:
            return f"rosrv drive free {group.name}"
        held = self._groups.holder(group.name) is not None
        return "" if held else group.order(host, self._policy().atoms_of(host), None)

    def unheard(self) -> AuthorityState | None:
        """Return the groups that no host commands while some would; null without groups."""
        groups = self._policy().authority
        states = [self._state(groups[name]) for name in sorted(groups)] if groups else []
        unheard = [
            UnheardGroup(state.group, state.why or f"no host holds {state.group}", state.not_carried)
            for state in states
            if any(one.order for one in state.not_carried)
        ]
        return AuthorityState(unheard) if groups else None

    def _ranked_state(self, group: AuthorityGroup) -> requests.GroupState:
        driver = self._ranked.driver(group)
        return requests.GroupState(
            group.name,
            sorted(group.names),
            driver.holder,
            round(clock.now() - driver.since, 1) if driver.holder else None,
            0.0,
            None,
            [],
            [group.in_words(rank) for rank in range(len(group.ranks))],
            driver.node if driver.holder else "",
            driver.standing,
            driver.why(group),
            self._not_carried(group),
        )
