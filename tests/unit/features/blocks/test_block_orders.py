import asyncio
import contextlib
import ipaddress
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from appliance.base import clock
from appliance.base.withdrawal import WithdrawnError, withdrawable
from appliance.channel.admin import PolicyReload
from appliance.control.assembly import host_blocks
from appliance.control.assembly.policies import Policies
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.features.blocks.orders import BlockOrders, is_own
from appliance.features.blocks.requests import BlockEnded, HostBlock, HostBlocked, HostBlocks, HostUnblock
from appliance.hosts.host_table import HostRefusedError
from appliance.master.graph.registry import Kind
from appliance.policy.judgement import PolicyContext
from appliance.policy.model import Category, Request, address_of
from appliance.policy.policy import CurrentPolicy, Policy
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from tests.support.control_parts import OPEN, ControlParts
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase
from tests.support.virtual_clock import let_time_pass, set_wall
from tests.support.waiting import until

pytestmark = pytest.mark.anyio
NODE, ROBOT, OTHER, OURS = "10.0.0.5", "10.0.0.1", "10.0.0.7", "10.0.0.2"


async def at_once() -> None: ...


class Control(ControlParts):
    def __init__(self, state: Path, connected: list[set[str]], text: str = OPEN) -> None:
        super().__init__()
        state.mkdir(exist_ok=True)
        (state / "policy.ini").write_text(text)
        self.state = StateStore(state, failed=print, kind=InlineDatabase)
        self.ends = ends_of(self.state, state)
        self.blocks = host_blocks.BlockTable(self.state, self.ends)
        self.remotes: dict[str, str] = {}
        self.uses: list[str] = []
        self.policies = Policies(
            state / "policy.ini", self.state, self.ends, self.records, CurrentPolicy(),
            known=lambda: PolicyContext(robot=[ipaddress.ip_network(ROBOT)], blocks=self.blocks.reasons),
            live=list, changed=self.changed, carried_out=at_once,
        )  # fmt: skip
        self.policies.start(restarted=False)
        self.current = self.policies.current
        self.orders = BlockOrders(
            self.blocks, self.policies, self.state, self.records, self.ends, live=self.revocation.live,
            connected=lambda: connected, enrolled=self.enrolled, remotes=lambda: self.remotes,
            uses=lambda _host: self.uses, carried_out=at_once, is_own=lambda address: str(address) == OURS,
        )  # fmt: skip

    def advance(self, seconds: float) -> None:
        let_time_pass(seconds)
        self.ends.read_clock()
        self.ends.look()

    def keep(self, task: asyncio.Task[None]) -> None:
        self._not_ours.add(task)

    def enrolled(self) -> Mapping[str, str]:
        return {"ocu-1": "10.99.0.2"}

    def changed(self, _before: Policy, policy: Policy) -> int:
        self.current = policy
        return self.enforcement.policy_changed(policy)

    async def block(self, address: str, seconds: float | None = None, **more: Any) -> HostBlocked:
        return await self.orders.block(HostBlock(address, seconds, **more), "ann")

    async def unblock(self, address: str) -> int:
        return (await self.orders.unblock(HostUnblock(address), "ann")).restored

    async def blocked(self) -> list[str]:
        return [row.address for row in (await self.orders.list_blocks(HostBlocks())).blocks]

    def denial(self, host: str, text: str = "") -> str | None:
        decision = self.current.decide(Request(address_of(host), "/node", Category.PUBLISH, "/scan"))
        return None if decision.allowed else decision.reason


@contextlib.asynccontextmanager
async def control(
    tmp_path: Path, connected: list[set[str]] | None = None, text: str = OPEN
) -> AsyncIterator[Control]:
    made = Control(tmp_path / "state", connected or [], text)
    timer = asyncio.create_task(made.ends.run())
    made.keep(timer)
    await made.round()
    try:
        yield made
    finally:
        timer.cancel()
        await asyncio.gather(timer, return_exceptions=True)
        await made.settle()
        made.state.close()


@pytest.fixture
async def made(tmp_path: Path) -> AsyncIterator[Control]:
    async with control(tmp_path) as made:
        yield made


async def test_a_block_ends_everything_and_what_is_lifted_returns(tmp_path: Path) -> None:
    async with control(tmp_path, [{NODE, ROBOT}, {ROBOT, OTHER}]) as made:
        node = made.node("/talker")
        await made.register(node, Kind.PUBLICATION, "/scan")
        await made.register(node, Kind.PUBLICATION, "/odom")
        await made.register(node, Kind.SERVICE, "/reset")
        answer = await made.block(NODE, note="strange traffic")
        assert answer.ended == BlockEnded(2, 0, 1, 0, 1)
        assert (answer.until, answer.replaced, answer.who) == (None, None, "ann")
        await made.settle()
        assert not made.hidden.has(Kind.PUBLICATION, "/scan")
        assert made.denial(OTHER) is None
        assert await made.unblock(NODE) == 3
        await made.settle()
        assert made.hidden.has(Kind.PUBLICATION, "/scan") == ["/talker"]
        assert made.denial(NODE) is None
        events = [event for event, _resource in made.records.pairs]
        assert events.count("revoked") == 3
        assert [event for event in events if event.startswith("host")] == ["host blocked", "host unblocked"]


async def test_the_reason_names_who_until_note_and_remedy(made: Control) -> None:
    await made.block(NODE, 3600, note="strange traffic")
    reason = made.denial(NODE)
    assert reason is not None
    assert reason.startswith(f"{NODE} is blocked by ann until 20")
    assert reason.endswith(f"Z: strange traffic; lift it with `rosrv host unblock {NODE}`")
    await made.orders.block(HostBlock("fd00:1111:2222:3333:4444:5555:6666:7777", 9, "n" * 200), "w" * 63)
    reason = made.denial("fd00:1111:2222:3333:4444:5555:6666:7777")
    assert reason is not None
    assert len(reason) < 300


async def test_audit_only_sections_deny_a_blocked_host(tmp_path: Path) -> None:
    text = "[Options]\naudit-only=all\n" + OPEN.replace("default=*", "default=10.0.0.9")
    async with control(tmp_path, text=text) as made:
        assert made.denial(NODE) is None
        await made.block(NODE)
        assert made.denial(NODE) is not None


async def test_a_registration_that_is_under_way_during_the_block_ends(made: Control) -> None:
    made.go.clear()
    call = asyncio.create_task(
        made.ask("registerPublisher", "/talker", "/scan", "t/T", f"http://{NODE}:4001/")
    )
    await until(lambda: ("allow", "/scan") in made.records.pairs)
    assert (await made.block(NODE)).ended.publications == 0
    made.go.set()
    await call
    await made.settle()
    assert ("registered", "/scan") in made.records.pairs
    assert not [one for one in made.revocation.live() if str(one.host) == NODE]


async def test_an_order_whose_client_gave_up_changes_nothing(made: Control) -> None:
    await made.block(OTHER)
    with withdrawable(lambda: True):
        with pytest.raises(WithdrawnError):
            await made.block(NODE)
        with pytest.raises(WithdrawnError):
            await made.unblock(OTHER)
    assert await made.blocked() == [OTHER]


async def test_a_block_ends_by_the_age_clock_and_not_by_the_system_clock(made: Control) -> None:
    node = made.node("/talker")
    await made.register(node, Kind.PUBLICATION, "/scan")
    began = clock.now()
    await made.block(NODE, 3600)
    await made.block(OTHER)
    set_wall(4e9)
    made.advance(3599.9)
    assert await made.blocked() == [NODE, OTHER]
    await until(lambda: made.denial(NODE) is None)
    assert clock.now() - began == pytest.approx(3600, abs=0.05)
    await made.settle()
    assert made.hidden.has(Kind.PUBLICATION, "/scan") == ["/talker"]
    assert await made.blocked() == [OTHER]
    assert ("host block ended", None) in made.records.pairs


async def test_blocks_survive_restarts_and_end_while_the_machine_is_off(tmp_path: Path) -> None:
    async with control(tmp_path) as made:
        await made.block(NODE, 3600, note="a")
        await made.block(OTHER, 60)
    let_time_pass(61)
    async with control(tmp_path) as made:
        await until(lambda: made.denial(OTHER) is None)
        assert (made.denial(NODE) or "").startswith(f"{NODE} is blocked by ann until")
        [row] = (await made.orders.list_blocks(HostBlocks())).blocks
        assert (row.address, row.note) == (NODE, "a")
        assert row.until is not None
        assert abs(row.until - (clock.wall() + 3539)) < 30
    async with control(tmp_path) as made:
        assert await made.blocked() == [NODE]


async def test_a_second_block_replaces_the_first(made: Control) -> None:
    await made.block(NODE, 60, note="first")
    answer = await made.block(f"::ffff:{NODE}", note="second")
    assert answer.replaced is not None
    assert (answer.address, answer.replaced.note, answer.until) == (NODE, "first", None)
    assert await made.blocked() == [NODE]
    assert "second" in (made.denial(NODE) or "")


async def test_spellings_and_names_of_a_host_are_one_block(made: Control) -> None:
    for text in (f"::ffff:{NODE}", "::FFFF:a00:5", "fd00::0:1", "fe80::1%eth0", "ocu-1", "host:ocu-1"):
        await made.block(text)
    assert await made.blocked() == [NODE, "fd00::1", "fe80::1", "10.99.0.2"]
    assert (made.denial("10.99.0.2") or "").startswith("10.99.0.2 is blocked")
    assert (made.denial(f"::ffff:{NODE}") or "").startswith(f"{NODE} is blocked")
    assert (await made.orders.list_blocks(HostBlocks())).blocks[-1].name == "ocu-1"
    await made.unblock("ocu-1")
    await made.unblock("fd00:0::1")
    assert await made.blocked() == [NODE, "fe80::1"]


async def test_the_answer_names_other_addresses_of_the_machine(made: Control) -> None:
    made.remotes = {"ocu-1": "192.0.2.20"}
    assert (await made.block("192.0.2.20")).other_addresses == ["10.99.0.2"]
    assert (await made.block("ocu-1")).other_addresses == []
    await made.unblock("192.0.2.20")
    assert (await made.block("ocu-1")).other_addresses == ["192.0.2.20"]


@pytest.mark.parametrize(
    "text", ["10.0.0.300", "10.0.0.0/24", "", "ocu-2", "10.0.0.5%eth0", "010.0.0.5", "x" * 500, "10.0.0.5\n"]
)
async def test_a_malformed_address_is_rejected(made: Control, text: str) -> None:
    with pytest.raises(SenselessError, match=r"is not (an address|one host: give one address$)"):
        await made.block(text)
    assert await made.blocked() == []


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("127.0.0.1", "own address"), ("127.1.2.3", "own address"), ("::1", "own address"),
        ("::ffff:127.0.0.1", "own address"), (OURS, "own address"), ("0.0.0.0", "cannot be"), ("::", "cannot be"),
        ("255.255.255.255", "cannot be"), ("224.0.0.1", "cannot be"), ("ff02::1", "cannot be"),
    ],
)  # fmt: skip
async def test_addresses_of_no_other_host_are_refused(made: Control, text: str, reason: str) -> None:
    with pytest.raises(HostRefusedError, match=reason):
        await made.block(text, force=True)


@pytest.mark.nightly
def test_own_addresses_are_those_that_a_socket_can_have() -> None:
    addresses = ("127.0.0.1", "192.0.2.1", "2001:db8::1")
    assert [is_own(ipaddress.ip_address(address)) for address in addresses] == [True, False, False]


@pytest.mark.parametrize("note", ["a\nb", "\x1b[31m"])
async def test_a_note_is_printable(made: Control, note: str) -> None:
    with pytest.raises(SenselessError, match="printable characters"):
        await made.block(NODE, note=note)


async def test_the_robot_is_blocked_only_by_force(tmp_path: Path) -> None:
    async with control(tmp_path, [{ROBOT, OTHER}, {OTHER}]) as made:
        with pytest.raises(HostRefusedError, match=r"robot's own host: .* 0 registrations and 1 connection"):
            await made.block(ROBOT)
        assert made.denial(ROBOT) is None
        assert (await made.block(ROBOT, force=True)).ended.connections == 1
        assert made.denial(ROBOT) is not None


async def test_a_host_with_most_registrations_is_blocked_only_by_force(made: Control) -> None:
    """One wrong digit must not stop the robot, whose nodes may be on any host."""
    for host, name in ((NODE, "/driver"), (OTHER, "/console")):
        node = made.node(name, host=address_of(host))
        for number in range(11):
            await made.register(node, Kind.PUBLICATION, f"{name}/{number}")
        with pytest.raises(HostRefusedError, match=r"has 11 of 11 registrations, .* would end 11 regis"):
            await made.block(host)
        assert made.denial(host) is None
        if host == NODE:
            assert (await made.block(host, force=True)).ended.publications == 11
    await made.unblock(NODE)
    assert (await made.block(OTHER)).ended.publications == 11


async def test_the_number_of_blocks_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("appliance.features.blocks.orders.MAX", 2)
    async with control(tmp_path) as made:
        await made.block(NODE)
        await made.block(OTHER)
        with pytest.raises(HostRefusedError, match="2 hosts are blocked, the limit"):
            await made.block("10.0.0.8")
        await made.block(NODE, 60)
        await made.unblock(OTHER)
        await made.block("10.0.0.8")


async def test_only_a_blocked_host_can_be_unblocked(made: Control) -> None:
    with pytest.raises(UnknownThingError, match=f"{NODE} is not blocked: `rosrv host blocks`"):
        await made.unblock(NODE)


async def test_an_order_at_the_moment_of_the_end_finds_one_state(made: Control) -> None:
    await made.block(NODE, 60)
    let_time_pass(60)
    made.ends.read_clock()
    orders = asyncio.gather(made.unblock(NODE), made.unblock(NODE), made.block(OTHER), return_exceptions=True)
    made.ends.look()
    outcomes = await orders
    await until(lambda: made.denial(NODE) is None)
    ends = [event for event, _ in made.records.pairs if event in {"host unblocked", "host block ended"}]
    assert len(ends) == 1
    assert sum(isinstance(outcome, UnknownThingError) for outcome in outcomes) == 2 - ends.count(
        "host unblocked"
    )


async def test_a_block_that_is_not_stored_is_in_force_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk must not keep an attacker in."""

    async def full() -> None:
        raise StoreError("state.db: no space left")

    async with control(tmp_path) as made:
        monkeypatch.setattr(made.state, "until_settled", full)
        with pytest.raises(StoreError, match="is blocked now, but a stop of the appliance ends it"):
            await made.block(NODE)
        assert made.denial(NODE) is not None


async def test_a_policy_that_is_loaded_keeps_the_blocks(made: Control) -> None:
    await made.block(NODE)
    made.policies.file.write_text(OPEN + "# changed\n")
    await made.policies.reload(PolicyReload(), "operator")
    assert made.current.text.endswith("# changed\n")
    assert made.denial(NODE) is not None
    made.policies.hosts_changed()
    assert made.denial(NODE) is not None
    assert made.policies.known.blocks.keys() == {address_of(NODE)}


async def test_a_dry_run_names_everything_and_blocks_nothing(tmp_path: Path) -> None:
    async with control(tmp_path, [{NODE, ROBOT}]) as made:
        await made.register(made.node("/talker"), Kind.PUBLICATION, "/scan")
        made.uses = ["session of ann (REST, last call 3 s ago)", "1 connection to the door alice"]
        answer = await made.block(NODE, 60, dry_run=True)
        assert answer.ended == BlockEnded(1, 0, 0, 0, 1, made.uses)
        assert answer.until is not None and await made.blocked() == []
        assert made.denial(NODE) is None
        assert [event for event, _resource in made.records.pairs if event.startswith("host")] == []
        assert (await made.block(NODE)).ended.uses == made.uses


async def test_a_tunnel_is_named_that_the_block_ends(made: Control) -> None:
    made.remotes = {"ocu-1": "192.0.2.20"}
    for either in ("ocu-1", "192.0.2.20"):
        assert (await made.block(either, dry_run=True)).ended.uses == ["the tunnel of ocu-1, from 192.0.2.20"]
    assert (await made.block(NODE, dry_run=True)).ended.uses == []


@pytest.mark.parametrize("address", [NODE, "ocu-1"])
async def test_the_callers_own_way_in_is_blocked_only_by_force(made: Control, address: str) -> None:
    made.remotes = {"ocu-1": NODE}
    for dry_run in (True, False):
        with (
            withdrawable(lambda: False, f"::ffff:{NODE}"),
            pytest.raises(HostRefusedError, match="your own requests come from"),
        ):
            await made.block(address, dry_run=dry_run)
    await made.block(address, dry_run=True)  # on the admin socket, which stays open
    with withdrawable(lambda: False, NODE):
        assert (await made.block(address, force=True)).address in (NODE, "10.99.0.2")
        await made.block(OTHER)
