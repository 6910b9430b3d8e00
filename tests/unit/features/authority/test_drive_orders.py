import asyncio
import random
import re
from collections.abc import Awaitable, Callable, Iterable, Iterator
from dataclasses import replace

import pytest

from appliance.base import clock
from appliance.channel.messages import OwnServiceCalled
from appliance.control.core import RelayOrders
from appliance.control.errors import SenselessError, UnavailableError, UnknownThingError
from appliance.features.authority.orders import CHECK_SECONDS, DriveOrders
from appliance.features.authority.ranked_groups import RankedGroups
from appliance.features.authority.requests import DriveAsk, DriveGive, DriveStatus, DriveTake, GroupState
from appliance.master.endpoints.host_signs import HostSigns
from appliance.master.endpoints.relay_control import RankStates
from appliance.policy.model import Address, Category, Request, address_of
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from tests.support.core import FakeTrail
from tests.support.idle import idle
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio
PILOT, SECOND, BOSS, AGENT, STRANGER = (f"10.0.0.{number}" for number in range(1, 6))
RELEASE_AFTER = 5.0
TEXT = f"""
[Authority]
base = /cmd_vel
take base = {PILOT} {SECOND}
override base = {BOSS}
ask base = {AGENT}
lease base = {RELEASE_AFTER:g}s
"""


class Site:
    def __init__(self, chance: random.Random, time: VirtualClock, signs: HostSigns | None = None) -> None:
        self.time = time
        self.chance = chance
        self.policy: Policy = compile_policy(TEXT, file="site.ini")
        self.live = {address_of(host) for host in (PILOT, SECOND, BOSS, AGENT, STRANGER)}
        self.moved: dict[Address, float] = {}
        self.trail = FakeTrail()
        self.applied: list[Address | None] = [None, None]
        self.ordered: list[list[Address | None]] = [[], []]
        self.ready = True
        self.hanging: set[str] = set()  # topics of a relay that does not answer
        relay = idle(RelayOrders)
        relay.ranks = RankStates(lambda _order: True)
        ranked = RankedGroups(
            lambda: self.policy, self.trail, relay, self.stop, node="/rosrv", find=lambda _key: ("", None)
        )
        self.orders = DriveOrders(
            lambda: self.policy, self.trail,
            signs or HostSigns(self.live.__contains__, lambda host, _names: self.moved.get(host, 0.0)),
            self.stop, ranked, decide_again=self.decide_again, carried_out=self.carried_out,
            relays_ready=lambda: self.ready,
        )  # fmt: skip

    async def stop(self, host: str, topics: Iterable[str], why: str) -> None:
        if not why.endswith("its nodes ended"):  # then it keeps the group for a time
            assert address_of(host) not in self.applied
            assert self.orders.holders() == {}
        self.trail.happened("motion stopped", why, topics=sorted(topics))

    def decide_again(self) -> int:
        for queue in self.ordered:
            queue.append(self.orders.holders().get("base"))
        return 0

    async def carried_out(self, topics: Iterable[str] | None) -> None:
        while self.hanging and (topics is None or self.hanging.intersection(topics)):
            await asyncio.sleep(0)
        while any(self.ordered):
            await asyncio.sleep(0)
            relay = self.chance.choice([number for number in (0, 1) if self.ordered[number]])
            self.applied[relay] = self.ordered[relay].pop(0)
            assert len({host for host in self.applied if host is not None}) <= 1, self.applied

    def handed_over(self) -> list[str]:
        return [
            f"{row['earlier']} -> {row['holder']}"
            for row in self.trail.rows
            if row["event"] == "authority handed over"
        ]

    async def state(self) -> GroupState:
        return (await self.orders.status(DriveStatus())).groups[0]

    async def pass_time(self, seconds: float, moving: Iterable[str] = ()) -> None:
        for _ in range(round(seconds / CHECK_SECONDS)):
            self.time.advance(CHECK_SECONDS)
            self.moved |= {address_of(host): clock.now() for host in moving}
            await self.orders.check()


@pytest.fixture
def site() -> Iterator[Site]:
    with clock.using(time := VirtualClock()):
        yield Site(random.Random(1), time)  # noqa: S311  a repeatable history


@pytest.mark.parametrize("number", [2_000, pytest.param(100_000, marks=pytest.mark.nightly)])
async def test_never_two_holders_and_never_none_for_longer_than_a_silence(site: Site, number: int) -> None:
    chance, hosts, hand_overs = site.chance, (PILOT, SECOND, BOSS, AGENT, STRANGER), 0
    orders, moves = site.orders, set[str]()
    kinds = (
        lambda host: orders.take(DriveTake("base", host), "op"),
        lambda host: orders.ask(DriveAsk("base", host), "op"),
        lambda host: orders.give(DriveGive("base", host), "op"),
        lambda _host: orders.give(DriveGive("base"), "op"),
        lambda host: orders.take_called(OwnServiceCalled(1, "/rosrv/drive/take", host, "/pad")),
        lambda host: orders.give_called(OwnServiceCalled(1, "/rosrv/drive/give", host, "/pad")),
    )
    while hand_overs < number:
        acts = [chance.choice(kinds)(chance.choice(hosts)) for _ in range(3)]
        for error in await asyncio.gather(*acts, orders.check(), return_exceptions=True):
            assert isinstance(error, SenselessError) or not isinstance(error, BaseException), error
        host = chance.choice(hosts)
        (moves.add if chance.random() < 0.5 else moves.discard)(host)
        (site.live.add if chance.random() < 0.8 else site.live.discard)(address_of(host))
        if chance.random() < 0.3:
            await site.pass_time(chance.choice((0.25, 1.0, RELEASE_AFTER + 0.5)), moves)
        hand_overs += len(site.handed_over())
        site.trail.records.clear()
        state = await site.state()
        assert site.applied == [address_of(state.holder) if state.holder else None] * 2
        if not state.holder:
            assert not {PILOT, SECOND, BOSS} & set(state.waiting), (
                "the group is free while a host waits for it"
            )
        else:
            assert state.left_seconds is not None
            assert state.left_seconds <= RELEASE_AFTER


async def test_the_next_holder_of_a_group(site: Site) -> None:
    orders = site.orders
    await orders.take(DriveTake("base", PILOT), "op")
    for host in (SECOND, AGENT, STRANGER):
        with pytest.raises(SenselessError):
            await orders.take(DriveTake("base", host), "op")
    await orders.ask(DriveAsk("base", AGENT), "op")
    await orders.ask(DriveAsk("base", SECOND), "op")
    with pytest.raises(SenselessError):
        await orders.ask(DriveAsk("base", STRANGER), "op")
    assert (await site.state()).waiting == [AGENT, SECOND]
    await orders.take(DriveTake("base", BOSS), "op")
    await orders.give(DriveGive("base"), "op")
    await orders.give(DriveGive("base", AGENT), "op")
    with pytest.raises(SenselessError):
        await orders.give(DriveGive("base", STRANGER), "op")
    await orders.give(DriveGive("base"), "op")
    assert site.handed_over() == [
        f"nobody -> {PILOT}", f"{PILOT} -> {BOSS}", f"{BOSS} -> {SECOND}", f"{SECOND} -> {AGENT}", f"{AGENT} -> nobody",
    ]  # fmt: skip
    assert [row["host"] for row in site.trail.rows if row["event"] == "authority refused"] == [
        SECOND, AGENT, STRANGER, STRANGER,
    ]  # fmt: skip
    handed_over = site.handed_over()
    assert (await orders.give(DriveGive("base"), "op")).holder == ""
    assert site.handed_over() == handed_over
    with pytest.raises(UnknownThingError, match="its groups: base"):
        await orders.take(DriveTake("arm", PILOT), "op")


@pytest.mark.parametrize("host", [PILOT, BOSS, AGENT])
@pytest.mark.parametrize("holder", ["", SECOND])
async def test_the_command_in_a_denial_does_what_the_host_needs(site: Site, host: str, holder: str) -> None:
    """The host then holds the group, or waits for it."""
    text = f"[Clients]\n/arm = {host}\n{TEXT.replace('/cmd_vel', '/cmd_vel /arm')}"
    site.policy = compile_policy(text, file="site.ini")
    if holder:
        await site.orders.take(DriveTake("base", holder), "op")
    policy = replace(site.policy, holders=site.orders.holders())
    denied = policy.decide(Request(address_of(host), "/n", Category.CALL, "/arm"))
    assert denied.told is not None
    command = re.search(r"rosrv drive (\w+) base --(?:host|to) (\S+)", denied.told)
    assert command is not None
    orders = {
        "assign": lambda: site.orders.take(DriveTake("base", command[2]), "op"),
        "ask": lambda: site.orders.ask(DriveAsk("base", command[2]), "op"),
        "free": lambda: site.orders.give(DriveGive("base", command[2]), "op"),
    }
    state = await orders[command[1]]()
    assert host in (state.holder, *state.waiting)
    assert holder in ("", state.holder) or host == BOSS


@pytest.mark.parametrize("host", ["ocus", "two", "10.0.0.0/24", "10.0.0.0/31"])
async def test_no_order_takes_the_first_address_of_a_network_for_a_host(site: Site, host: str) -> None:
    groups = f"[Groups]\nocus = 10.0.0.0/29\ntwo = {PILOT} {SECOND}\n"
    site.policy = compile_policy(groups + TEXT.replace(BOSS, f"{BOSS} ocus two"), file="site.ini")
    orders: list[Callable[[], Awaitable[GroupState]]] = [
        lambda: site.orders.take(DriveTake("base", host), "op"),
        lambda: site.orders.ask(DriveAsk("base", host), "op"),
        lambda: site.orders.give(DriveGive("base", host), "op"),
    ]
    for order in orders:
        with pytest.raises(SenselessError, match="is not one host: give one address"):
            await order()
    assert not site.trail.rows


async def test_an_order_for_another_holder_than_the_present_one_is_refused(site: Site) -> None:
    orders = site.orders
    await orders.take(DriveTake("base", PILOT, holder=""), "op")
    await orders.take(DriveTake("base", BOSS, holder=PILOT), "other")
    late: list[Callable[[], Awaitable[object]]] = [
        lambda: orders.give(DriveGive("base", holder=PILOT), "op"),
        lambda: orders.give(DriveGive("base", AGENT, holder=""), "op"),
        lambda: orders.take(DriveTake("base", BOSS, holder=PILOT), "op"),
    ]
    for order in late:
        with pytest.raises(SenselessError, match=f"handed over in the meantime: {BOSS} holds it"):
            await order()
        assert (await site.state()).holder == BOSS
    assert (await orders.give(DriveGive("base", holder=BOSS), "op")).holder == ""
    with pytest.raises(SenselessError, match=f"no host holds it, not {BOSS}"):
        await orders.give(DriveGive("base", holder=BOSS), "op")


async def test_a_holder_loses_a_group(site: Site) -> None:
    take = DriveTake("base", PILOT)
    await site.orders.take(take, "op")
    await site.pass_time(3 * RELEASE_AFTER, [PILOT])
    await site.pass_time(RELEASE_AFTER - 1)
    await site.orders.take(take, "op")  # takes it again
    await site.pass_time(RELEASE_AFTER - 1)
    assert (await site.state()).holder == PILOT
    await site.pass_time(1)
    await site.orders.take(take, "op")
    await site.pass_time(1, [PILOT])
    site.live.discard(address_of(PILOT))
    site.moved.pop(address_of(PILOT))  # a node's traffic is forgotten with it
    await site.pass_time(RELEASE_AFTER - 1)
    assert (await site.state()).holder == PILOT, "a node that restarts keeps its group"
    site.live.add(address_of(PILOT))
    await site.pass_time(1, [PILOT])
    await site.pass_time(RELEASE_AFTER)
    for text in (TEXT.replace(PILOT, "10.0.0.9"), TEXT.replace("base", "arm")):
        site.policy = compile_policy(TEXT, file="site.ini")
        await site.orders.take(take, "op")
        site.policy = compile_policy(text, file="site.ini")
        await site.pass_time(CHECK_SECONDS)
    reasons = [row["reason"].rpartition(": ")[2] for row in site.trail.rows if row.get("holder") == "nobody"]
    assert reasons == [
        "it was silent for 5 s", "it was silent for 5 s", "the policy no longer lets it hold the group",
        "the policy no longer has the group",
    ]  # fmt: skip
    stops = [row["reason"] for row in site.trail.rows if row["event"] == "motion stopped"]
    ended = [*reasons[:1], "its nodes ended", *reasons[1:3]]
    assert stops == [f"base: {reason}" for reason in ended], "its messages pass without a group"


async def test_a_host_that_loses_its_claim_for_an_instant_loses_the_group(site: Site) -> None:
    """Such as a door that is removed and added again, with the same name and address. It may take the group again."""
    for again in (False, True):
        await site.orders.take(DriveTake("base", PILOT), "op")
        for text in (TEXT.replace(PILOT, "10.0.0.9"), TEXT):
            site.policy = compile_policy(text, file="site.ini")
            site.orders.policy_changed()
        assert site.orders.holders() == {}
        if again:
            await site.orders.take(DriveTake("base", PILOT), "op")
        await site.pass_time(CHECK_SECONDS)
        assert (await site.state()).holder == (PILOT if again else "")
    assert site.handed_over() == [
        f"nobody -> {PILOT}", f"{PILOT} -> nobody", f"nobody -> {PILOT}", f"{PILOT} -> {PILOT}"
    ]  # fmt: skip


@pytest.mark.parametrize("host", [PILOT, BOSS, AGENT])
@pytest.mark.parametrize("by", ["node", "operator"])
async def test_a_holder_that_asks_again_keeps_the_group_and_waits_for_nothing(
    site: Site, host: str, by: str
) -> None:
    """Also one that may only ask, and so cannot take the group again."""
    orders = site.orders
    await orders.give(DriveGive("base", host), "op")
    for _ in range(3):
        await site.pass_time(RELEASE_AFTER - 1)
        if by == "node":
            answer = await orders.take_called(OwnServiceCalled(1, "/rosrv/drive/take", host, "/pad"))
            assert (answer.success, answer.text) == (True, f"{host} holds base")
        else:
            await orders.ask(DriveAsk("base", host), "op")
    assert ((await site.state()).holder, (await site.state()).waiting) == (host, [])
    await orders.give(DriveGive("base"), "op")
    assert (await site.state()).holder == ""


async def test_a_relay_that_hangs_delays_the_end_of_no_other_group(site: Site) -> None:
    arm = TEXT.replace("[Authority]", "").replace("base", "arm").replace("/cmd_vel", "/arm")
    site.policy = compile_policy(TEXT + arm, file="site.ini")
    for group in ("base", "arm"):
        await site.orders.take(DriveTake(group, PILOT), "op")
    site.hanging = {"/cmd_vel"}
    site.time.advance(RELEASE_AFTER)
    check = asyncio.ensure_future(site.orders.check())
    for _ in range(9):
        await asyncio.sleep(0)
    assert site.orders.holders() == {}
    assert [row["topics"] for row in site.trail.rows if row["event"] == "motion stopped"] == [["/arm"]]
    await site.orders.check()  # both hand-overs are under way
    site.hanging.clear()
    await check
    assert site.trail.rows[-1]["event"] == "authority handed over"


async def test_nothing_is_handed_over_while_a_relay_starts(site: Site) -> None:
    await site.orders.take(DriveTake("base", PILOT), "op")
    await site.orders.ask(DriveAsk("base", SECOND), "op")
    site.ready = False
    with pytest.raises(UnavailableError):
        await site.orders.take(DriveTake("base", BOSS), "op")
    await site.orders.give(DriveGive("base"), "op")
    await site.pass_time(1)
    assert site.handed_over() == [f"nobody -> {PILOT}", f"{PILOT} -> nobody"]
    site.ready = True
    await site.pass_time(1)
    assert site.handed_over()[2:] == [f"nobody -> {SECOND}"]


async def test_a_relay_that_is_lost_during_a_hand_over_lets_no_two_hosts_through(site: Site) -> None:
    for take in (
        lambda: site.orders.take(DriveTake("base", BOSS), "op"),
        lambda: site.orders.take_called(OwnServiceCalled(7, "/rosrv/drive/take", BOSS, "/pad")),
    ):
        await site.orders.take(DriveTake("base", PILOT), "op")
        order = asyncio.ensure_future(take())
        await asyncio.sleep(0)
        site.ready = False
        [answer] = await asyncio.gather(order, return_exceptions=True)
        assert isinstance(answer, UnavailableError) or not getattr(answer, "success", True)
        assert (await site.state()).holder == ""
        site.ready = True


async def test_a_node_takes_and_gives_for_its_host(site: Site) -> None:
    def called(host: str) -> OwnServiceCalled:
        return OwnServiceCalled(7, "/rosrv/drive/take", host, "/pad")

    answers = [await site.orders.take_called(called(host)) for host in (PILOT, SECOND, AGENT, STRANGER)]
    assert [(answer.success, answer.text.split(":")[0]) for answer in answers] == [
        (True, f"{PILOT} holds base"),
        (False, f"{PILOT} holds base"),
        (False, "base"),
        (False, f"{STRANGER} has no claim to a group of [Authority]"),
    ]
    assert not any(answer.repeats for answer in answers)  # it may be outdated at the host's next call
    assert (await site.orders.give_called(called(SECOND))).text == f"{SECOND} holds no group"
    assert (await site.orders.give_called(called(PILOT))).success
    assert (await site.state()).holder == ""
