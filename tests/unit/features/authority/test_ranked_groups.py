"""Records and messages about the drivers that relays report."""

import asyncio
import random
from collections.abc import Collection, Iterable
from typing import Any

import pytest

from appliance.base import clock
from appliance.channel.messages import OwnHeaderStated, OwnPublished, RankFreed, RankReported
from appliance.control.errors import SenselessError, UnavailableError
from appliance.features.authority.ranked_groups import STRING, RankedGroups
from appliance.master.endpoints.relay_control import RankStates
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from roswire.standard import standard_definitions
from tests.support.core import FakeTrail
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio
OCU, ROBOT = "10.0.0.1", "10.0.0.2"
TEXT = f"[Authority]\nbase = /cmd_vel\nrank base = {OCU}/pad > {ROBOT}\narm = /arm\ntake arm = {OCU}\n"
NODES = {"p": ("/pad", OCU), "q": ("/planner", ROBOT)}


class Relay:
    """Stands in for the relays: it obeys at once, unless it is `away`."""

    def __init__(self) -> None:
        self.away = False
        self.ordered: list[RankFreed] = []
        self.published: list[OwnPublished] = []
        self.topics: list[str] = []
        self.ranks = RankStates(self.send)

    def send(self, order: RankFreed) -> bool:
        self.ordered.append(order)
        return not self.away

    def publish(self, message: OwnPublished) -> None:
        self.published.append(message)

    def publish_only(self, _owner: str, headers: Iterable[OwnHeaderStated]) -> None:
        self.topics = [header.topic for header in headers if header.latching]

    async def carried_out(self, topics: Collection[str]) -> None:
        assert topics == {"/cmd_vel"}


def as_any(double: Any) -> Any:
    return double


class Site:
    def __init__(self) -> None:
        self.policy: Policy = compile_policy(TEXT, file="site.ini")
        self.relay = Relay()
        self.trail = FakeTrail()
        self.stopped: list[tuple[str, set[str]]] = []
        self.nodes = dict(NODES)
        self.ranked = RankedGroups(
            lambda: self.policy, self.trail, as_any(self.relay), self.stop, node="/rosrv", find=self.find
        )
        self.ranked.policy_changed()

    def find(self, key: str) -> tuple[str, Address | None]:
        name, host = self.nodes.get(key, ("", ""))
        return name, address_of(host) if host else None

    @property
    def records(self) -> list[str]:
        rows = [row for row in self.trail.rows if row["event"] == "authority handed over"]
        return [f"{row['earlier']} -> {row['holder']}: {row['reason']}" for row in rows]

    async def stop(self, host: str, topics: Iterable[str], _why: str) -> None:
        self.stopped.append((host, {*topics}))

    def report(self, key: str, standing: Any, rank: int = 0) -> None:
        self.relay.ranks.reported(RankReported("/cmd_vel", key, rank, standing))

    @property
    def said(self) -> str:
        message = self.relay.published[-1]
        assert message.topic == "/rosrv/driver/base"
        return str(message.data[4:], "utf-8")

    async def free(self) -> None:
        await self.ranked.free(self.policy.authority["base"], "ann")


@pytest.fixture
def site() -> Site:
    with clock.using(VirtualClock()):
        return Site()


def test_each_hand_over_is_a_record_and_a_message(site: Site) -> None:
    """With the nodes, and the reason."""
    assert site.relay.topics == ["/rosrv/driver/base"]
    assert f"only {OCU}/pad may move it" in site.said
    site.report("q", "moving", 1)
    assert site.said == f"/planner on {ROBOT} moves it"
    site.report("p", "moving")
    site.report("p", "free")
    assert f"/pad on {OCU} let go" in site.said
    assert site.records == [
        f"nobody -> {ROBOT}: base: from nobody to {ROBOT}: moved (/planner)",
        f"{ROBOT} -> {OCU}: base: from {ROBOT} to {OCU}: moved (/pad)",
        f"{OCU} -> nobody: base: from {OCU} to nobody: let go (/pad)",
    ]
    count = len(site.relay.published)
    site.report("p", "free")
    assert len(site.relay.published) == count, "a report is repeated after a restart"


async def test_the_guards_stop_what_a_lost_driver_commanded(site: Site) -> None:
    """Its name is known even if its node has ended. It still holds the group; if it is back, nothing is stopped."""
    task = asyncio.create_task(site.ranked.stop_lost())
    site.report("p", "moving")
    site.nodes.clear()
    site.report("p", "lost")
    await asyncio.sleep(0)
    assert site.stopped == [(OCU, {"/cmd_vel"})]
    assert f"/pad on {OCU} fell silent" in site.said
    site.report("p", "moving")
    site.report("p", "lost")
    site.report("p", "moving")
    await asyncio.sleep(0)
    assert len(site.stopped) == 1
    assert len(site.records) == 1
    task.cancel()


async def test_an_operator_frees_a_group_of_a_lost_driver(site: Site) -> None:
    """And no other one: a node that moves would drive again at once."""
    site.report("p", "moving")
    with pytest.raises(SenselessError, match="/pad moves base"):
        await site.free()
    site.report("p", "lost")
    site.relay.away = True
    with pytest.raises(UnavailableError):
        await site.free()
    site.relay.away = False
    await site.free()
    assert site.relay.ordered[-1] == RankFreed("/cmd_vel")
    assert site.records[-1] == f"{OCU} -> nobody: base: from {OCU} to nobody: freed by ann (/pad)"
    assert "ann freed it" in site.said
    ordered = len(site.relay.ordered)
    await site.free()
    assert len(site.relay.ordered) == ordered


async def test_an_operator_frees_a_group_whose_driver_is_not_known(site: Site) -> None:
    """Such as after a start."""
    await site.free()
    assert site.relay.ranks.of("/cmd_vel").standing == "free"


def test_the_type_of_the_topics_is_the_standard_one() -> None:
    """Its definition is written out, so that control need not load all of them."""
    known, kind = standard_definitions(), STRING[0]
    assert (kind, known.md5sum(kind), known.full_text(kind)) == STRING


def test_a_policy_without_the_rank_forgets_its_driver(site: Site) -> None:
    """So another rank of the topic begins without one."""
    site.report("p", "moving")
    site.policy = compile_policy("[Authority]\narm = /arm\n", file="site.ini")
    site.ranked.policy_changed()
    assert site.relay.topics == []
    assert site.relay.ranks.of("/cmd_vel").standing == "unknown"
    site.report("p", "free")
    assert site.records[1:] == [
        f"{OCU} -> nobody: base: from {OCU} to nobody: the policy no longer ranks the group (/pad)"
    ]


POLICIES = {
    "ranked": TEXT,
    "without": f"[Authority]\narm = /arm\ntake arm = {OCU}\n",
    "held": f"[Authority]\nbase = /cmd_vel\ntake base = {OCU}\n",
    "renamed": TEXT.replace("base", "legs"),
}
WHY = {"moving": "moved", "lost": "fell silent", "free": "let go", "unknown": "no longer ranks"}


@pytest.mark.parametrize("seed", range(20))
def test_the_records_name_each_holder_of_each_ranked_group(site: Site, seed: int) -> None:
    """After reports, changes of the policy and restarts of RVMaster, the last record of a group has its holder."""
    chance, held = random.Random(seed), dict[str, str]()  # noqa: S311  a history by seed
    trail, policy = site.trail, site.policy
    for _step in range(60):
        known, standing = trail.rows, ""
        match chance.choice("rrrrrpps"):
            case "r":
                standing = chance.choice(("moving", "lost", "free"))
                site.report(chance.choice("pq"), standing)
            case "p":
                site.policy = policy = compile_policy(
                    POLICIES[chance.choice(list(POLICIES))], file="site.ini"
                )
                site.ranked.policy_changed()
            case "s":
                held.clear()  # the record of the restart says that no host holds a group
                site = Site()
                site.trail = site.ranked._trail = trail
                site.policy = policy
                site.ranked.policy_changed()
        for row in trail.rows[len(known) :]:
            assert held.get(row["resource"], "nobody") == row["earlier"]
            held[row["resource"]] = row["holder"]
            assert WHY[standing] in row["reason"] if standing else True
        ranked = [group for group in policy.authority.values() if group.ranks]
        holders = {group.name: holder for group in ranked if (holder := site.ranked.driver(group).holder)}
        assert {name: holder for name, holder in held.items() if holder != "nobody"} == holders
