import asyncio
import hashlib
import itertools
import random
import re
from collections.abc import Awaitable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

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
    def __init__(self, time: VirtualClock, ends: EndTable, signs: HostSigns | None = None) -> None:
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
            lambda: self.policy, self.trail,
            signs or HostSigns(lambda _host: True, lambda _host, _names: self.moved), self.stop, ends,
            first=17, decide_again=self.decide_again, carried_out=self.carried_out,
            bearers=lambda: self.bearers, guards=self.guards, held=lambda *_entry: None,
        )  # fmt: skip
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
        if decision.allowed:
            return ""
        return self.orders.hold_call(decision.asks or Request(AGENT, "", category, "")).text

    async def held(self) -> list[Approval]:
        return (await self.orders.list_approvals(ApprovalsWanted())).approvals


@pytest.fixture
def site(tmp_path: Path) -> Any:
    with clock.using(time := VirtualClock()):
        yield Site(time, ends_in(tmp_path))


def number_in(text: str) -> int:
    match = NUMBER.search(text)
    assert match, text
    return int(match[1])


class Held(NamedTuple):
    """A held call as operators see it, and the tokens of its approver."""

    number: int
    state: str  # or `lease`, for some time
    until: float
    who: str = ""
    tokens: frozenset[str] = frozenset()


Key = tuple[Address, Category, str, bytes | None]  # None: any arguments
ANN, AGAIN, BOB = bearer("1", "ann"), bearer("4", "ann"), bearer("2", "bob", "admin")
TOKENS = ([ANN, BOB], [AGAIN, BOB], [ANN, AGAIN], [BOB, bearer("1", "ann", "viewer")])


class Promises:
    """The promises about approvals: the calls that are held, and the records about them."""

    def __init__(self) -> None:
        self.held: dict[Key, Held] = {}
        self.numbers: dict[Key, int] = {}  # of calls that no operator answered
        self.bearers = TOKENS[0]
        self.asks = True
        self.next = 17
        self.records: list[str] = []

    def call(self, key: Key) -> str:
        """Return a part of the answer to its host; nothing if the call passes."""
        if not self.asks:
            return ""
        one = key if key in self.held else (*key[:3], None)
        now = self.held.get(one)
        if now is not None and key[1] is Category.CALL and now.tokens and (over := self.over(now)):
            self.end(one, over)
            now = self.held.get(key)
        elif now is not None and now.tokens:
            if now.state == "approved":
                del self.held[one]
                self.records.append(f"used approval {now.number}")
            return ""
        if now is None:
            if sum(other[0] == key[0] for other in self.held) == 8:
                return "the quota of one host is 8"
            number = self.numbers.pop(key, self.next)
            self.next = max(self.next, number + 1)
            now = self.held[key] = Held(number, "waits", clock.now() + WAIT_SECONDS)
            self.records.append(f"waits for approval {number}")
        return f"{'an operator refused' if now.state == 'refused' else 'held for'} approval {now.number}"

    def approve(self, number: int, seconds: float | None, who: str, *, waits: bool) -> str:
        """Return a part of the error, or nothing."""
        if (key := self.key(number)) is None:
            return "rosrv approve lists all"
        one, is_call = self.held[key], key[1] is Category.CALL
        if (waits and one.state != "waits") or (one.state == "refused" and not one.who == who != "operator"):
            return f"is already {'approved' if one.tokens else 'refused'} by {one.who}"
        if seconds is None and one.state == "lease" and is_call:
            return "is for some time"
        seconds = APPROVED_SECONDS if seconds is None and not is_call else seconds
        tokens = {token.id for token in self.bearers if token.name == who and token.role != "viewer"}
        del self.held[key]
        once, until = seconds is None, clock.now() + (seconds or WAIT_SECONDS)
        approved = Held(number, "approved" if once else "lease", until, who, frozenset(tokens or {who}))
        for other in [] if once else [other for other in self.held if other[:3] == key[:3]]:
            self.end(other, f"approval {number} covers it")
        self.held[key if once else (*key[:3], None)] = approved
        self.records.append(f"{who} gave approval {number}, {'once' if once else f'for {seconds:g} s'}")
        return ""

    def refuse(self, number: int, who: str) -> str:
        if (key := self.key(number)) is None:
            return "rosrv approve lists all"
        if self.held[key].tokens:
            self.end(key, f"{who} ended it")
        else:
            self.held[key] = Held(number, "refused", clock.now() + WAIT_SECONDS, who)
            self.records.append(f"{who} refused approval {number}")
        return ""

    def key(self, number: int) -> Key | None:
        found = (key for key, one in self.held.items() if one.number == number and one.until > clock.now())
        return next(found, None)

    def over(self, one: Held) -> str:
        if one.until <= clock.now():
            return "no operator answered in time" if one.state == "waits" else "its time is over"
        approvers = {token.id for token in self.bearers if token.role != "viewer"} | {"operator"}
        lost = one.tokens and not one.tokens & approvers
        words = f"{one.who}, who approved it, no longer has a token or session with the role operator"
        return words if lost else ""

    def end(self, key: Key, why: str) -> None:
        self.records.append(f"approval {self.held.pop(key).number} ended: {why}")

    def check(self) -> None:
        for key, one in [*self.held.items()]:
            if why := self.over(one):
                if one.state == "waits":
                    self.numbers[key] = one.number
                self.end(key, why)

    def change_policy(self) -> None:
        self.asks = not self.asks
        if not self.asks:
            self.numbers.clear()
        for key in [*self.held]:
            self.end(key, "the policy no longer asks")


@pytest.mark.parametrize("seed", range(16))
async def test_approvals_are_as_promised_in_any_order(site: Site, seed: int) -> None:
    chance, promised = random.Random(seed), Promises()  # noqa: S311  a history by seed
    asking, site.bearers = site.text, TOKENS[0]
    for _step in range(150):
        category = chance.choice((Category.CALL, Category.CALL, Category.PUBLISH, Category.WRITE))
        number = chance.choice([*(one.number for one in promised.held.values()), promised.next])
        who, host = chance.choice(("ann", "bob", "operator")), chance.choice((AGENT, OTHER))
        match chance.choice("ccccccaaarrttbp"):
            case "c":
                is_call, name = category is Category.CALL, chance.choice(("/x", "/y"))
                body = chance.choice((b"1", b"2", b"3", b"4"))
                told = await site.call(body, host, name) if is_call else site.publish(name, category)
                key = (host, category, name, body) if is_call else (AGENT, category, name, None)
                expected = promised.call(key)
                assert expected in told and bool(expected) == bool(told)
            case "a":
                seconds, waits = chance.choice((None, None, 1.0, 3.0, 60.0, 3600.0)), chance.random() < 0.3
                order = site.orders.approve(ApproveCall(number, seconds, waits=waits), who)
                await is_answered(order, promised.approve(number, seconds, who, waits=waits))
            case "r":
                await is_answered(site.orders.refuse(RefuseCall(number), who), promised.refuse(number, who))
            case "t" if chance.random() < 0.2:  # no check comes in time
                site.time.advance(chance.choice((3, 60, 120)))
            case "t":
                for _quarter in range(chance.choice((1, 4, 12, 480))):
                    await site.pass_time(CHECK_SECONDS)
                    promised.check()
            case "b":
                site.bearers = promised.bearers = chance.choice(TOKENS)
            case "p" if chance.random() < 0.5:
                allowing = compile_policy(f"[Publishers]\ndefault = {AGENT}\n", file="site.ini")
                blocking = replace(asking, blocks=dict.fromkeys((AGENT, OTHER), "blocked by ann"))
                blocks = promised.asks and chance.random() < 0.5
                for other in (blocking, asking) if blocks else (allowing if promised.asks else asking,):
                    site.text = other
                    promised.change_policy()
                    site.decide_again()
                await site.orders.check()
                promised.check()
        shown = {(one.number, one.state, one.who, one.left_seconds) for one in await site.held()}
        assert shown == {
            (one.number, one.state, one.who, max(0.0, round(one.until - clock.now(), 1)))
            for one in promised.held.values()
        }
        leases = {key[:3] for key, one in promised.held.items() if one.state == "lease"}
        enforced = frozenset(lease for lease in leases if lease[1] is not Category.CALL)
        assert not promised.asks or site.policy.approved == enforced
        assert site.orders.limits()[0].used == len(shown)
        texts = [row["reason"] for row in site.trail.rows if row["event"].startswith("approval")]
        assert sorted(text.partition(": ")[2] for text in texts) == sorted(promised.records)


PARTS = {"once": ("", "held for"), "for": ("", ""), "refuse": ("refused",) * 2, "waits": ("held for",) * 2}
"""By the last answer about a call: a part of what its host gets to hear, twice."""

ANSWERS = [(call, answer) for call in "AB" for answer in ("once", "for", "refuse")]


@pytest.mark.parametrize("answers", list(itertools.product(ANSWERS, repeat=3)), ids=str)
async def test_the_last_answer_about_a_call_decides_it(
    site: Site, answers: Iterable[tuple[str, str]]
) -> None:
    """An approval for some time is an answer about all calls of its name. Each approval that was given has an end."""
    numbers = {call: number_in(await site.call(call.encode())) for call in ("A", "B")}
    about = dict.fromkeys(numbers, "waits")
    lasting = 0  # the number of the approval for some time
    for call, answer in answers:
        number = numbers[call]
        try:
            if answer == "refuse":
                await site.orders.refuse(RefuseCall(number), "ann")
            else:
                await site.orders.approve(ApproveCall(number, 300.0 if answer == "for" else None), "ann")
        except (SenselessError, UnknownThingError):
            assert lasting, "only an approval for some time makes numbers invalid"
        else:
            ends = lasting == number and answer == "refuse"
            lasting = number if answer == "for" else 0 if ends else lasting
            over = ends or (answer == "refuse" and about[call] == "once")
            changed = numbers if ends or answer == "for" else (call,)
            about |= dict.fromkeys(changed, "waits" if over else answer)
            for one in changed if over else ():
                numbers[one] = number_in(await site.call(one.encode()))
    for call, answer in about.items():
        told = [await site.call(call.encode()) for _again in range(2)]
        for part, text in zip(PARTS[answer], told, strict=True):
            assert part in text and bool(part) == bool(text)
    assert [one.state for one in await site.held()].count("waits") == site.orders.state().waiting
    await site.pass_time(301)
    given, ended = (
        {row["approval"] for row in site.trail.rows if row["event"] in events}
        for events in (("approval given",), ("approval ended", "approval used"))
    )
    assert given <= ended


async def is_answered(order: Awaitable[object], error: str) -> None:
    try:
        await order
    except (SenselessError, UnknownThingError) as refusal:
        assert error and error in str(refusal)
    else:
        assert not error


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


async def test_the_robot_stops_when_the_approver_loses_the_role(site: Site) -> None:
    number = number_in(site.publish("/cmd_vel"))
    await site.orders.approve(ApproveCall(number, 60.0), "ann")
    await site.pass_time(10)
    assert site.publish("/cmd_vel") == "" and not site.stops
    site.bearers = [bearer("1", "ann", "viewer")]
    await site.pass_time(CHECK_SECONDS)
    assert number_in(site.publish("/cmd_vel")) != number
    assert site.stops == [(str(AGENT), {"/cmd_vel"})]


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


async def test_a_number_ends_with_the_right_of_its_host_although_no_check_came_since_its_time(
    site: Site,
) -> None:
    number, asking = number_in(site.publish("/x")), site.text
    site.time.advance(WAIT_SECONDS)
    for text in (compile_policy("[Publishers]\n", file="site.ini"), asking):
        site.text = text
        site.decide_again()
    assert number_in(site.publish("/x")) != number
