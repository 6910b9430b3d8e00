import asyncio
import hashlib
import random
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from appliance.base import clock
from appliance.channel.messages import RequestHeld
from appliance.channel.messages.api import TokenKept
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.features.approvals.approval_table import WAIT_SECONDS
from appliance.features.approvals.orders import APPROVED_SECONDS, CHECK_SECONDS, ApprovalOrders
from appliance.features.approvals.requests import Approval, ApprovalsWanted, ApproveCall, RefuseCall
from appliance.features.approvals.view import APPROVALS_VIEW
from appliance.master.endpoints.host_signs import HostSigns
from appliance.policy.model import Address, Category, Request, address_of
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import Right, decide_right
from appliance.store.ends import EndTable
from tests.support.core import FakeTrail
from tests.support.ends import ends_in
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio
AGENT, OTHER = address_of("10.0.0.7"), address_of("10.0.0.8")
TEXT = f"""
[Publishers]
default = ask {AGENT} {OTHER}
[Clients]
default = ask {AGENT} {OTHER}
[Parameters]
write default = ask {AGENT}
[Authority]
base = /cmd_vel
take base = {AGENT}
lease base = 5s
"""
NUMBER = re.compile(r"held for approval ([0-9]+); ask the operator, then repeat; expires in ([0-9]+) s")


def bearer(number: str, name: str, role: str = "operator") -> TokenKept:
    return TokenKept(number, name, role, b"", b"", 0.0)


class Site:
    def __init__(self, time: VirtualClock, ends: EndTable) -> None:
        self.time = time
        self.text = compile_policy(TEXT, file="site.ini")
        self.policy: Policy
        self.trail = FakeTrail()
        self.stops: list[tuple[str, set[str]]] = []
        self.moved = 0.0
        self.guarded: list[str] = []
        self.asked: list[str] = []
        self.hanging: set[str] = set()  # topics of a relay that does not answer
        self.replaced = asyncio.Event()  # that relay
        self.bearers = [bearer("1", "ann")]
        self.orders = ApprovalOrders(
            lambda: self.policy,
            self.trail,
            HostSigns(lambda _host: True, lambda _host, _names: self.moved),
            self.stop,
            ends,
            first=17,
            decide_again=self.decide_again,
            carried_out=self.carried_out,
            bearers=lambda: self.bearers,
            guards=self.guards,
            held=lambda *_entry: None,
        )
        self.decide_again()

    def decide_again(self) -> int:
        self.policy = replace(self.text, approved=self.orders.approved())
        self.orders.policy_changed()
        return 0

    async def carried_out(self, topics: Iterable[str]) -> None:
        assert self.policy.approved == self.orders.approved()
        if self.hanging.intersection(topics):
            await self.replaced.wait()

    async def stop(self, host: str, topics: Iterable[str], _why: str) -> None:
        assert not any(
            (address_of(host), Category.PUBLISH, topic) in self.orders.approved() for topic in topics
        )
        self.stops.append((host, {*topics}))

    async def guards(self, topic: str) -> list[str] | None:
        self.asked.append(topic)
        if topic in self.hanging:
            return None
        return ["deadman"] if topic in self.guarded else []

    def events(self) -> list[str]:
        return [event.removeprefix("approval ") for event in self.trail.events if event != "decision"]

    async def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / CHECK_SECONDS)):
            self.time.advance(CHECK_SECONDS)
            await self.orders.check()

    async def call(self, body: bytes = b"", host: Address = AGENT, service: str = "/home") -> str:
        digest = hashlib.sha256(body).hexdigest()
        wanted = RequestHeld(1, service, str(host), "/it", "std_srvs/SetBool", digest, body, len(body))
        return (await self.orders.approve_call(wanted)).refused

    def publish(self, topic: str, category: Category = Category.PUBLISH) -> str:
        decision = self.policy.decide(Request(AGENT, "/it", category, topic))
        return (
            ""
            if decision.allowed
            else self.orders.hold_call(decision.asks or Request(AGENT, "", category, "")).text
        )

    async def held(self) -> list[Approval]:
        return (await self.orders.listed(ApprovalsWanted())).approvals


@pytest.fixture
def site(tmp_path: Path) -> Any:
    with clock.using(time := VirtualClock()):
        yield Site(time, ends_in(tmp_path))


def number_in(text: str) -> int:
    found = NUMBER.search(text)
    assert found, text
    return int(found[1])


async def test_an_approval_of_one_call_is_used_once(site: Site) -> None:
    first = number_in(await site.call(b"1"))
    assert first == number_in(await site.call(b"1")) == 17
    assert number_in(await site.call(b"2")) != first
    shown = await site.orders.approve(ApproveCall(first), "ann")
    assert (shown.state, shown.who, shown.left_seconds) == ("approved", "ann", WAIT_SECONDS)
    for refusal in (
        await site.call(b"2"),
        await site.call(b"1", OTHER),
        await site.call(b"1", service="/other"),
    ):
        assert number_in(refusal) != first
    assert await site.call(b"1") == ""
    assert number_in(await site.call(b"1")) != first
    assert [record.decision for record in site.trail.records].count("allow") == 1
    assert site.events().count("used") == 1


async def test_an_approval_of_a_service_for_some_time_is_for_any_arguments_until_its_time(site: Site) -> None:
    number = number_in(await site.call(b"1"))
    await site.orders.approve(ApproveCall(number, 10.0), "ann")
    assert [await site.call(body) for body in (b"1", b"2", b"1")] == ["", "", ""]
    assert number_in(await site.call(b"1", OTHER)) != number
    site.time.advance(10)
    assert await site.call(b"1"), "also before the watch has ended it"
    await site.pass_time(CHECK_SECONDS)
    assert number_in(await site.call(b"1")) != number


async def call_approved_for_some_time(site: Site) -> int:
    number = number_in(await site.call(b"1"))
    await site.orders.approve(ApproveCall(number, 10.0), "ann")
    return number


@pytest.mark.parametrize("category", [Category.PUBLISH, Category.WRITE])
async def test_a_topic_and_a_parameter_are_approved_for_some_time(site: Site, category: Category) -> None:
    number = number_in(site.publish("/x", category))
    assert number_in(site.publish("/x", category)) == number
    assert number_in(site.publish("/y", category)) != number
    assert (await site.orders.approve(ApproveCall(number), "ann")).left_seconds == APPROVED_SECONDS
    assert site.publish("/x", category) == ""
    await site.pass_time(APPROVED_SECONDS - 1)
    assert site.publish("/x", category) == ""
    await site.pass_time(1)
    assert number_in(site.publish("/x", category)) != number
    with pytest.raises(SenselessError, match="is for some time"):
        await site.orders.approve(ApproveCall(await call_approved_for_some_time(site)), "ann")


async def test_an_approved_motion_ends_by_silence_and_the_guards_stop_the_robot(site: Site) -> None:
    """A motion is a topic in a group or with a guard. Silence counts from the first message."""
    site.guarded = ["/arm"]
    for topic in ("/cmd_vel", "/arm", "/other"):
        await site.orders.approve(ApproveCall(number_in(site.publish(topic)), 60.0), "ann")
    await site.pass_time(20)
    assert site.publish("/cmd_vel") == "" and not site.asked
    site.moved = clock.now()
    await site.pass_time(4.5)
    assert site.publish("/cmd_vel") == site.publish("/arm") == "" and not site.stops
    await site.pass_time(0.5)
    assert site.publish("/cmd_vel") and site.publish("/arm")
    assert site.publish("/other") == "" and site.asked == ["/arm", "/other"]
    assert site.stops == [(str(AGENT), {"/cmd_vel"}), (str(AGENT), {"/arm"})]
    site.moved = clock.now()
    await site.pass_time(5)
    assert site.asked[2:] == ["/other"], "once in each silence"
    site.moved = 0.0  # its publisher ended
    await site.pass_time(60)
    assert site.stops[2:] == [(str(AGENT), {"/other"})], "its guards stop it too, if there are any"


async def test_a_relay_that_hangs_delays_the_end_of_no_other_approval(site: Site) -> None:
    site.guarded, site.hanging = ["/arm", "/b"], {"/a", "/arm"}
    approved = [asyncio.ensure_future(approve(site, topic, 2.0)) for topic in ("/a", "/b")]
    approved.append(asyncio.ensure_future(approve(site, "/arm", 60.0)))
    await asyncio.sleep(0)
    assert [site.publish(topic) for topic in ("/a", "/b", "/arm")] == ["", "", ""]
    site.time.advance(2)
    checks = [asyncio.ensure_future(site.orders.check())]
    await asyncio.sleep(0.01)
    assert site.publish("/a") and site.publish("/b")
    assert site.stops == [(str(AGENT), {"/b"})], "without the answer of the relay that carries /a"
    site.moved = clock.now()
    for _ in range(2):  # its guards did not answer, so they are asked again
        site.time.advance(5)
        checks.append(asyncio.ensure_future(site.orders.check()))
        await asyncio.sleep(0.01)
    assert site.publish("/arm") == "" and site.asked == ["/arm", "/arm"]
    site.hanging.clear()
    site.replaced.set()
    await asyncio.gather(*approved, *checks, site.orders.check())
    assert site.publish("/arm")
    assert site.stops[1:] == [(str(AGENT), {"/a"}), (str(AGENT), {"/arm"})]


async def approve(site: Site, topic: str, seconds: float) -> None:
    await site.orders.approve(ApproveCall(number_in(site.publish(topic)), seconds), "ann")


async def test_an_approval_that_is_extended_still_ends_by_silence(site: Site) -> None:
    number = number_in(site.publish("/cmd_vel"))
    await site.orders.approve(ApproveCall(number, 60.0), "ann")
    await site.pass_time(1)
    site.moved = clock.now()
    await site.pass_time(1)
    await site.orders.approve(ApproveCall(number, 60.0), "ann")
    await site.pass_time(4)
    assert site.publish("/cmd_vel")
    assert site.stops


async def test_the_end_of_an_approval_stops_the_robot_without_a_report_of_a_message(site: Site) -> None:
    """Relays report once a second, and never for a node that has ended. A host without the group moved nothing."""
    for holder in (AGENT, OTHER):
        site.text = replace(site.text, holders={"base": holder})
        site.decide_again()
        await site.orders.approve(ApproveCall(number_in(site.publish("/cmd_vel")), 1.0), "ann")
        await site.pass_time(1)
    assert site.stops == [(str(AGENT), {"/cmd_vel"})]


async def test_a_namespace_is_approved_although_only_what_is_below_it_asks(site: Site) -> None:
    site.text = compile_policy(
        f"[Parameters]\nwrite /arm = {AGENT}\nwrite default = ask {AGENT}", file="site.ini"
    )
    site.decide_again()
    below = Right(Request(AGENT, "/it", Category.WRITE, "/arm"), namespace=True)
    asked = decide_right(site.policy, below).asks
    assert asked is not None
    await site.orders.approve(ApproveCall(number_in(site.orders.hold_call(asked).text), 10.0), "ann")
    await site.pass_time(9)
    assert decide_right(site.policy, below).allowed


async def test_an_operator_refuses_a_call_and_ends_an_approval(site: Site) -> None:
    number = number_in(await site.call())
    await site.orders.refuse(RefuseCall(number), "ann")
    first, again = [(await site.call()).rpartition(" [")[0] for _call in range(2)]  # without the record's id
    assert first == again
    assert f"an operator refused approval {number}" in again
    await site.pass_time(WAIT_SECONDS)
    [ended] = [row["reason"] for row in site.trail.rows if row["event"] == "approval ended"]
    assert ended.endswith(f"approval {number} ended: its time is over")
    approval = number_in(site.publish("/x"))
    await site.orders.approve(ApproveCall(approval), "ann")
    await site.orders.refuse(RefuseCall(approval), "ann")
    assert number_in(site.publish("/x")) != approval
    for order in (
        site.orders.approve(ApproveCall(approval), "ann"),
        site.orders.refuse(RefuseCall(number), "ann"),
    ):
        with pytest.raises(UnknownThingError, match="rosrv approve lists all"):
            await order


async def test_a_call_without_an_answer_ends_with_an_alarm(site: Site) -> None:
    [view] = APPROVALS_VIEW.states
    number = number_in(await site.call())
    assert not [*view.alarms(site.orders.state())]
    await site.pass_time(WAIT_SECONDS)
    [alarm] = view.alarms(site.orders.state())
    assert alarm.kind == "approval-unanswered"
    assert number_in(await site.call()) == number  # the operator may have it from the agent
    await site.pass_time(1)
    site.time.advance(600)
    assert not [*view.alarms(site.orders.state())]


async def test_an_approval_ends_when_the_policy_no_longer_asks(site: Site) -> None:
    """At once: the next policy may ask again before the next check."""
    for change in ("[Publishers]\n", "block"):
        number = number_in(site.publish("/x"))
        await site.orders.approve(ApproveCall(number, 3600.0), "ann")
        before = site.text
        site.text = compile_policy("[Publishers]\n", file="site.ini")
        if change == "block":
            site.text = replace(before, blocks={AGENT: "blocked by ann"})
        site.decide_again()
        site.text = before
        site.decide_again()
        assert number_in(site.publish("/x")) != number


async def test_a_door_that_is_added_again_has_no_approval_of_the_removed_one(site: Site) -> None:
    """It has the same name and address. The robot stops."""
    asks = "[Publishers]\ndefault = ask door:agent\n[Authority]\nbase = /cmd_vel\ntake base = door:agent\n"

    def set_doors(doors: dict[str, Address]) -> None:
        site.text = compile_policy(asks, file="site.ini", hosts=doors)
        site.decide_again()

    set_doors({"door:agent": AGENT})
    number = number_in(site.publish("/cmd_vel"))
    await site.orders.approve(ApproveCall(number, 3600.0), "ann")
    set_doors({})
    set_doors({"door:agent": AGENT})
    assert number_in(site.publish("/cmd_vel")) != number
    await site.orders.check()
    assert site.stops == [(str(AGENT), {"/cmd_vel"})]
    assert "approval 17 ended: the policy no longer asks" in site.trail.rows[-2]["reason"]


@pytest.mark.parametrize(
    "left",
    [
        pytest.param([], id="removed"),
        pytest.param([bearer("2", "ann", "viewer")], id="another role"),
        pytest.param([bearer("2", "ann", "admin")], id="another token of this name"),
    ],
)
async def test_an_approval_ends_with_the_role_of_its_approver(site: Site, left: list[TokenKept]) -> None:
    """The robot stops, and the record has the reason."""
    number = number_in(site.publish("/cmd_vel"))
    await site.orders.approve(ApproveCall(number, 60.0), "ann")
    await site.pass_time(10)
    assert site.publish("/cmd_vel") == "" and not site.stops
    site.bearers = left
    await site.pass_time(CHECK_SECONDS)
    assert number_in(site.publish("/cmd_vel")) != number
    assert site.stops == [(str(AGENT), {"/cmd_vel"})]
    [ended] = [one for one in site.trail.rows if one["event"] == "approval ended"]
    assert ended["reason"].endswith(
        f"approval {number} ended: ann, who approved it, no longer has a token or session with the role operator"
    )


@pytest.mark.parametrize("seconds", [None, 60.0])
async def test_a_call_is_refused_as_soon_as_its_approver_has_lost_the_role(
    site: Site, seconds: float | None
) -> None:
    number = number_in(await site.call())
    await site.orders.approve(ApproveCall(number, seconds), "ann")
    site.bearers = []
    assert number_in(await site.call()) != number
    assert site.events()[-2:] == ["ended", "wanted"]


async def test_an_approval_outlives_one_of_two_tokens_of_its_approver_and_any_other(site: Site) -> None:
    """The admin socket needs no token. A later approval of the same call replaces the approver."""
    site.bearers = [bearer("1", "ann"), bearer("2", "ann"), bearer("3", "bob", "admin")]
    numbers = [number_in(site.publish(topic)) for topic in ("/a", "/b", "/c")]
    for number, who in zip(numbers, ("ann", "operator", "ann"), strict=True):
        await site.orders.approve(ApproveCall(number, 60.0), who)
    await site.orders.approve(ApproveCall(numbers[2], 60.0), "bob")
    site.bearers = site.bearers[1:]
    await site.pass_time(1)
    assert [site.publish(topic) for topic in ("/a", "/b", "/c")] == ["", "", ""]
    site.bearers = site.bearers[1:]
    await site.pass_time(1)
    assert [bool(site.publish(topic)) for topic in ("/a", "/b", "/c")] == [True, False, False]


async def test_a_host_has_a_quota_of_waiting_calls(site: Site) -> None:
    for body in range(20):
        await site.call(bytes([body]))
    assert len(await site.held()) == 8
    assert "the quota of one host is 8; ask the operator about those first" in await site.call(b"more")
    assert number_in(await site.call(b"1", OTHER))
    [use] = site.orders.limits()
    assert (use.used, use.host, use.host_used) == (9, str(AGENT), 8)
    await site.pass_time(WAIT_SECONDS)
    assert await site.held() == []
    assert number_in(await site.call(b"more"))


async def test_many_addresses_leave_another_host_its_calls(site: Site) -> None:
    text = TEXT.replace("[Clients]\n", "[Clients]\n/net = ask 10.1.0.0/16\n/every = ask *\n")
    site.text = compile_policy(text, file="site.ini")
    site.decide_again()
    for service, most in (("/net", 8), ("/every", 64)):
        before = len(await site.held())
        for number in range(32):
            host = address_of(f"10.{1 if service == '/net' else 2}.0.{number + 1}")
            for body in (b"1", b"2", b"3"):
                refusal = await site.call(body, host, service)
        assert len(await site.held()) - before == most
        assert refusal.startswith("not held")
    site.text = compile_policy(TEXT, file="site.ini")  # the policy no longer has the network
    assert number_in(await site.call(b"1"))
    await site.pass_time(WAIT_SECONDS)
    assert site.orders.limits()[0].used == 0


async def test_no_call_passes_without_an_approval_of_its_own(site: Site) -> None:
    chance = random.Random(11)  # noqa: S311  a history by seed
    once: list[tuple[Address, bytes]] = []
    ends: dict[Address, float] = {}
    for _ in range(2000):
        host, body = chance.choice((AGENT, OTHER)), chance.choice((b"1", b"2", b"3"))
        match chance.randrange(4):
            case 0:
                if waiting := [one for one in await site.held() if one.state == "waits"]:
                    one, seconds = chance.choice(waiting), chance.choice((None, 3.0))
                    await site.orders.approve(ApproveCall(one.number, seconds), "ann")
                    if seconds is None:
                        assert one.size == 1
                        once.append((address_of(one.host), bytes.fromhex(one.arguments)))
                    else:
                        ends[address_of(one.host)] = clock.now() + seconds
            case 1:
                await site.pass_time(chance.choice((0.25, 1, 2)))
            case _:
                approved = ends.get(host, 0.0) > clock.now()
                if not await site.call(body, host) and not approved:
                    once.remove((host, body))


async def test_a_repeated_call_keeps_its_number_only_with_equal_arguments(site: Site) -> None:
    number = number_in(await site.call(b"a"))
    await site.pass_time(WAIT_SECONDS)
    assert number_in(await site.call(b"b")) != number
    assert number_in(await site.call(b"a")) == number
    await site.orders.approve(ApproveCall(number, None), "ann")
    assert not await site.call(b"a")
    assert number_in(await site.call(b"a")) != number  # an approval that was used is not renewed


async def test_the_number_of_a_call_ends_with_the_right_of_its_host(site: Site) -> None:
    """A door that is removed and added again has the same name and address."""
    number = number_in(site.publish("/x"))
    await site.pass_time(WAIT_SECONDS)
    before = site.text
    site.text = compile_policy("[Publishers]\n", file="site.ini")
    site.decide_again()
    site.text = before
    site.decide_again()
    assert number_in(site.publish("/x")) != number


@pytest.mark.parametrize("waited", [0.0, 60.0, 119.0])
async def test_a_refusal_pauses_for_two_minutes_however_often_the_call_is_repeated(
    site: Site, waited: float
) -> None:
    number = number_in(await site.call())
    await site.pass_time(waited)
    await site.orders.refuse(RefuseCall(number), "ann")
    for _second in range(int(WAIT_SECONDS) - 1):
        assert "an operator refused" in await site.call()
        await site.pass_time(1)
    await site.pass_time(1)
    assert number_in(await site.call()) != number


def test_doors_know_the_words_of_a_held_call(site: Site) -> None:
    assert "held for approval" in site.publish("/x")


async def test_no_operator_replaces_the_answer_of_another_unseen(site: Site) -> None:
    await site.call(b"one")
    [one] = await site.held()
    await site.orders.refuse(RefuseCall(one.number), "ann")
    with pytest.raises(SenselessError, match="already refused by ann"):
        await site.orders.approve(ApproveCall(one.number, 30.0, waits=True), "bob")
    assert [row.state for row in await site.held()] == ["refused"]
    await site.orders.approve(ApproveCall(one.number, 30.0), "bob")
    with pytest.raises(SenselessError, match="already approved by bob"):
        await site.orders.approve(ApproveCall(one.number, 300.0, waits=True), "ann")
