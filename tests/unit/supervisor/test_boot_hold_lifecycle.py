import asyncio
import socket
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Literal, cast

import pytest

from appliance.base.clock import using
from appliance.configuration.settings import FirewallSection, Settings
from appliance.network import boot_hold
from appliance.network.boot_hold import BootHold, HeldPorts, hold_rules
from appliance.network.firewall.backend import FirewallError
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.namespaces import Namespace
from appliance.supervisor import run as supervisor_run
from appliance.supervisor import supervisor
from appliance.supervisor.errors import PortInUseError
from appliance.supervisor.isolation_lifecycle import NoIsolation
from appliance.supervisor.machine_work import NoMachineWork
from appliance.supervisor.role import Facts
from appliance.supervisor.run import HoldAround
from tests.support.virtual_clock import VirtualClock


class RecordedHold(BootHold):
    is_present = True

    def __init__(self, *, lapsed: bool = False, broken: bool = False) -> None:
        super().__init__(Namespace.own())
        self.calls: list[object] = []
        self._lapsed, self._broken = lapsed, broken
        self.flushed = False

    def put(self, *, nodes: bool = True) -> bool:
        self.calls.append("put" if nodes else "put master")
        if self._broken:
            raise FirewallError("no back end works")
        removed, self.flushed = self.flushed, False
        return removed

    def is_intact(self) -> bool:
        return not self.flushed

    def lift(self) -> bool:
        self.calls.append("lift")
        if self._broken:
            raise FirewallError("other machines are still held off")
        return self._lapsed

    def arm(self, held: HeldPorts | None) -> None:
        self.calls.append(held and (held.master, held.link, held.own_seconds))


def around(
    hold: BootHold,
    mode: Literal["others", "own", "off"] = "others",
    *,
    isolation: Literal["netns", "none"] = "netns",
    used: bool = True,
) -> HoldAround:
    settings = Settings(isolation=isolation, firewall=FirewallSection(hold=mode))
    return HoldAround(settings, used=used, link="veth-rosrv", hold=hold)


@pytest.mark.parametrize(
    ("made", "armed"),
    [
        (around, (11311, "veth-rosrv", None)),
        (lambda hold: around(hold, "own"), (11311, "veth-rosrv", 60)),
    ],
)
def test_the_service_holds_until_it_serves_and_at_its_end(
    made: Callable[[BootHold], HoldAround], armed: object
) -> None:
    hold = RecordedHold()
    run = made(hold)
    run.put()
    assert run.lift_hold() == ""
    run.put()
    assert hold.calls == ["put", "lift", armed, "put"]


@pytest.mark.parametrize(("again", "calls"), [(True, ["put master", "put"]), (False, ["put"])])
def test_before_a_restart_other_machines_wait_while_a_graph_is_given_back(
    monkeypatch: pytest.MonkeyPatch, again: bool, calls: list[str]
) -> None:
    monkeypatch.setattr(supervisor_run, "starts_again", lambda: again)
    hold = RecordedHold()
    run = around(hold)
    run.put_before_restart()
    run.put()
    assert hold.calls == calls


def test_a_hold_before_a_restart_that_fails_does_not_stop_the_giving_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supervisor_run, "starts_again", lambda: True)
    around(RecordedHold(broken=True)).put_before_restart()
    hold = RecordedHold()
    around(hold, "off").put_before_restart()
    assert hold.calls == []


def test_while_a_graph_is_given_back_nodes_of_other_machines_connect() -> None:
    held = HeldPorts(11311, 32_768, 60_999, "veth-rosrv")
    ports = [rule.tcp_ports for rule in hold_rules(held, 0, nodes=False) if rule.tcp_ports is not None]
    assert ports == [PortRange.one(11311)]


@pytest.mark.anyio
async def test_other_machines_wait_until_the_robots_graph_is_taken_over() -> None:
    hold, taken = RecordedHold(), asyncio.Event()
    run = around(hold)
    run.put()
    keeping = asyncio.create_task(run.until(taken.is_set))
    await asyncio.sleep(600)
    assert hold.calls == ["put"]
    hold.flushed = True
    await asyncio.sleep(10)
    assert hold.calls == ["put", "put"], "the hold is restored meanwhile"
    taken.set()
    assert "another program removed the boot hold" in await keeping
    assert run.lift_hold() == await keeping
    assert hold.calls == ["put", "put", "lift", (11311, "veth-rosrv", None)]


class Robot(NoIsolation):
    state = ""

    def awaits_graph(self) -> bool:
        return self.state == "awaits"

    def is_released(self) -> bool:
        return self.state == "released"


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("states", "armed"),
    [
        ("serves", True),
        ("serves awaits", True),
        ("serves released", False),
        ("awaits serves released", False),
        ("awaits released", False),
        ("released", False),
        ("serves released awaits", False),
        ("released awaits serves", True),
        ("serves released awaits serves", True),
    ],
)
async def test_the_next_boot_holds_unless_the_robot_was_released_since_it_was_served(
    states: str, armed: bool
) -> None:
    hold, robot, ready = RecordedHold(), Robot(), cast(supervisor.Supervisor, SimpleNamespace(is_ready=True))
    keeping = asyncio.create_task(supervisor_run._keep(around(hold), ready, robot))
    for robot.state in states.split():
        await asyncio.sleep(1)
    keeping.cancel()
    assert hold.calls[-2:] == ["lift", (11311, "veth-rosrv", None) if armed else None]


@pytest.mark.parametrize("armed", [False, True])
def test_a_wait_says_that_other_machines_are_held_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, armed: bool
) -> None:
    monkeypatch.setattr(boot_hold, "NftBackend", lambda *_: MemoryBackend())
    monkeypatch.setattr(boot_hold, "IptablesBackend", lambda *_: MemoryBackend())
    hold, robot = BootHold(Namespace.own(), unit_runs=tmp_path, state=tmp_path), Robot()
    hold.arm(HeldPorts(11311, 32768, 60999) if armed else None)

    def build() -> None:
        raise PortInUseError("roscore holds TCP 11311")

    monkeypatch.setattr(robot, "build", build)
    run = around(hold)
    run.put()
    with pytest.raises(PortInUseError) as raised:
        supervisor_run._build(Settings(isolation="netns"), robot, run)
    assert ("other machines are held off until" in str(raised.value)) is armed


@pytest.mark.parametrize(
    "made",
    [
        lambda hold: around(hold, "off"),
        lambda hold: around(hold, isolation="none"),
        lambda hold: around(hold, used=False),
    ],
)
def test_a_run_without_a_hold_ends_an_earlier_one(made: Callable[[BootHold], HoldAround]) -> None:
    hold = RecordedHold()
    run = made(hold)
    run.put()
    run.lift_hold()
    assert hold.calls == ["lift", None]


def test_a_lapsed_hold_is_an_alarm_only_if_the_robot_waited() -> None:
    assert "served more than 60 s" in around(RecordedHold(lapsed=True), "own").lift_hold()
    assert around(RecordedHold(lapsed=True)).lift_hold() == ""


def test_a_hold_that_fails_does_not_end_the_appliance() -> None:
    around(RecordedHold(broken=True)).put()


def test_a_hold_that_cannot_be_lifted_is_an_alarm_and_the_appliance_serves() -> None:
    hold = RecordedHold(broken=True)
    assert "still held off: run `systemctl stop rosrv-hold`" in around(hold).lift_hold()
    assert hold.calls == ["lift", (11311, "veth-rosrv", None)]


class MemoryBackend:
    """A back end whose rules another program may flush, or which cannot remove them."""

    name = "memory"

    def __init__(self, *held: object, stuck: bool = False) -> None:
        self.held, self._stuck = held, stuck

    def install(self, rules: tuple[object, ...]) -> None:
        self.held = rules

    def remove(self) -> None:
        if self._stuck:
            raise FirewallError("it is busy")
        self.held = ()

    def counters(self) -> tuple[object, ...]:
        return self.held


@pytest.mark.parametrize("has_rules", [True, False])
def test_only_rules_that_are_in_force_keep_a_hold_from_being_lifted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, has_rules: bool
) -> None:
    monkeypatch.setattr(boot_hold, "NftBackend", lambda *_: MemoryBackend(*[1] * has_rules, stuck=True))
    monkeypatch.setattr(boot_hold, "IptablesBackend", lambda *_: MemoryBackend(stuck=True))
    hold = BootHold(Namespace.own(), unit_runs=tmp_path, state=tmp_path)
    with pytest.raises(FirewallError, match="memory: it is busy") if has_rules else nullcontext():
        hold.lift()


def test_rules_that_another_program_removed_are_restored_and_the_start_says_so() -> None:
    time = VirtualClock()
    with using(time):
        hold = RecordedHold()
        run = around(hold)
        run.put()
        hold.flushed = True
        run.keep()
        assert hold.calls == ["put"], "it looks every five seconds"
        time.advance(5.0)
        run.keep()
        run.keep()
        assert hold.calls == ["put", "put"]
        assert "removed the boot hold 1 time, such as `nft flush ruleset`" in run.lift_hold()


def test_a_hold_knows_that_its_rules_were_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rules = MemoryBackend()
    monkeypatch.setattr(boot_hold, "NftBackend", lambda *_: rules)
    monkeypatch.setattr(boot_hold, "IptablesBackend", lambda *_: MemoryBackend())
    hold = BootHold(Namespace.own(), unit_runs=tmp_path, state=tmp_path)
    assert not hold.put(), "a hold that is not armed"
    hold.arm(HeldPorts(11311, 32768, 60999))
    assert [hold.put(), hold.put(), hold.is_intact()] == [False, False, True]
    rules.held = ()
    assert not hold.is_intact()
    assert hold.put()
    hold.lift()
    assert hold.is_intact(), "no hold is wanted"
    assert not hold.put()


@pytest.mark.nightly
@pytest.mark.anyio
async def test_other_machines_are_held_before_a_graph_is_given_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "_AGREED_SECONDS", 0.01)
    steps: list[str] = []
    monkeypatch.setattr(NoMachineWork, "takes_over", lambda _work: True)
    monkeypatch.setattr(NoMachineWork, "end", lambda _work: steps.append("end"))
    facts = Facts(state=tmp_path, config=tmp_path / "config.json", rosmaster_port=1)
    with socket.create_server(("127.0.0.1", 0)) as admin:
        ending = supervisor.Supervisor(
            (),
            facts,
            admin=admin,
            ready=lambda _said: None,
            work=NoMachineWork(),
            gives_back=lambda: steps.append("hold"),
        )
        ending.is_ready = True
        ending.stop()
        await ending.run()
    assert steps == ["hold", "end"]
