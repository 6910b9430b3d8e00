"""Control orders each step on the machine: none that no order of an operator leads to is carried out."""

import dataclasses
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.base.clock import using
from appliance.features.adopt import machine_side
from appliance.features.adopt.adopt_record import AdoptRecord, Phase, boot_id, load_record, save_record
from appliance.features.adopt.machine_facts import MachineFacts, RobotMaster
from appliance.features.adopt.machine_side import AdoptWork, wanted_record
from appliance.features.adopt.operator_orders import ADOPT, RELEASE, show_order
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.isolation import Isolation, IsolationSettings, LinkAddresses
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.socket_owners import NodeSockets
from tests.support.virtual_clock import VirtualClock

MASTER = RobotMaster(7, "/usr/bin/rosmaster", "robot", "roscore.service")
OPENING = ("stand in", "withdraw", "leave")
NODE, DATABASE = 40001, 5432


@dataclasses.dataclass
class Machine:
    state: Path
    done: list[str]
    refused: list[set[int]]
    connected: set[int]
    time: VirtualClock
    work: AdoptWork

    def order(self, work: str, **terms: object) -> dict[str, object]:
        side = Isolation(Namespace.own(), IsolationSettings(ports=(PortRange.one(22000),), master=11311))
        side.ends[4] = LinkAddresses("10.111.0.0/30", "10.111.0.1", "10.111.0.2")
        return self.work.carry_out(side, work, terms)

    def begin(self, phase: Phase, *, wanted: bool = True) -> None:
        save_record(self.state, AdoptRecord(wanted=wanted, phase=phase, boot=boot_id()))

    @property
    def record(self) -> AdoptRecord:
        return load_record(self.state)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    (tmp_path / "run").mkdir()
    done: list[str] = []
    refused: list[set[int]] = []
    connected = {NODE}

    def sockets(_host: object, ports: set[int], _master: int) -> dict[int, NodeSockets]:
        masters = dict.fromkeys(connected, "127.0.0.1")
        return {port: NodeSockets(port, frozenset({port}), masters.get(port, "")) for port in ports}

    def end(*_arguments: object, **_named: object) -> int:
        done.append("cut")
        return 1

    monkeypatch.setattr(Isolation, "forward_master", lambda _side: done.append("forward"))
    monkeypatch.setattr(Isolation, "withdraw_master", lambda _side: done.append("withdraw"))
    monkeypatch.setattr(machine_side, "master_of", lambda *_: MASTER)
    monkeypatch.setattr(machine_side, "end_connections", end)
    monkeypatch.setattr(
        machine_side, "refuse_ports", lambda _host, _link, ports, _remote: refused.append(set(ports))
    )
    monkeypatch.setattr(machine_side, "refuse_no_port", lambda _host: None)
    monkeypatch.setattr(machine_side, "node_sockets", sockets)
    monkeypatch.setattr(machine_side, "process_key", lambda pid: f"{pid}:1")
    monkeypatch.setattr("appliance.network.socket_owners.process_key", lambda pid: f"{pid}:1")
    monkeypatch.setattr(machine_side, "_LOOKUP_SECONDS", 0.0)
    time = VirtualClock()
    with using(time):
        yield Machine(tmp_path, done, refused, connected, time, AdoptWork(tmp_path))


def test_an_adoption_and_a_release_need_an_operators_order_each(machine: Machine) -> None:
    with pytest.raises(ValueError, match="no operator ordered an adoption"):
        machine.order("want", wanted=True)
    with show_order(machine.state, ADOPT):
        machine.order("want", wanted=True)
    assert (machine.record.wanted, machine.record.unit) == (True, "roscore.service")
    for phase in (Phase.TAKING, Phase.TAKEN):
        machine.order("phase", phase=phase)
    with pytest.raises(ValueError, match="no operator ordered a release"):
        machine.order("want", wanted=False)
    with show_order(machine.state, RELEASE):
        machine.order("want", wanted=False)
    assert not machine.record.wanted


def test_an_order_is_used_once_and_for_two_minutes(machine: Machine) -> None:
    machine.begin(Phase.TAKEN)
    with show_order(machine.state, RELEASE):
        machine.time.advance(121.0)
        with pytest.raises(ValueError, match="no operator"):
            machine.order("want", wanted=False)
    with show_order(machine.state, RELEASE):
        machine.order("want", wanted=False)
        machine.begin(Phase.TAKEN)
        with pytest.raises(ValueError, match="no operator"):
            machine.order("want", wanted=False)
    with show_order(machine.state, ADOPT), pytest.raises(ValueError, match="no operator"):
        machine.order("want", wanted=False)


def test_an_adoption_that_fails_is_undone_without_another_order(machine: Machine) -> None:
    with show_order(machine.state, ADOPT):
        machine.order("want", wanted=True)
    machine.order("phase", phase=Phase.TAKING)
    machine.order("want", wanted=False)
    machine.order("withdraw")
    assert machine.done[0] == "withdraw"


@pytest.mark.parametrize("step", OPENING)
@pytest.mark.parametrize("phase", [Phase.FREE, Phase.TAKING, Phase.TAKEN])
def test_no_step_opens_an_adopted_robot(machine: Machine, step: str, phase: Phase) -> None:
    machine.begin(phase)
    with pytest.raises(ValueError, match="does not follow from an operator"):
        machine.order(step)
    assert machine.done == []
    assert machine.record.phase is phase


def test_no_phase_is_skipped_on_the_way_to_the_own_master(machine: Machine) -> None:
    for phase in (Phase.FREE, Phase.GIVING, Phase.GIVEN):
        machine.begin(Phase.TAKEN)
        with pytest.raises(ValueError, match="taken does not become"):
            machine.order("phase", phase=phase)


@pytest.mark.parametrize("way", ["release", "end"])
def test_a_release_and_an_ordered_end_open_it(machine: Machine, way: str) -> None:
    machine.begin(Phase.TAKEN, wanted=way == "end")
    if way == "end":
        machine.work.end()
    machine.order("stand in")
    machine.order("withdraw")
    for phase in (Phase.GIVEN, Phase.FREE):
        machine.order("phase", phase=phase)
    assert machine.record.phase is Phase.FREE


@pytest.mark.parametrize(
    ("phase", "wanted"), [(Phase.FREE, True), (Phase.GIVING, False), (Phase.TAKEN, False)]
)
def test_no_connection_ends_except_while_a_graph_is_taken(
    machine: Machine, phase: Phase, wanted: bool
) -> None:
    machine.begin(phase, wanted=wanted)
    for step in ("cut", "forward"):
        with pytest.raises(ValueError, match="no graph is taken over"):
            machine.order(step, ports=[NODE])
    assert machine.done == []


def test_only_ports_of_processes_that_look_like_nodes_are_cut(machine: Machine) -> None:
    machine.begin(Phase.TAKING)
    done = machine.order("cut", ports=[NODE, DATABASE])
    assert machine.refused == [{NODE}]
    assert done["kept"] == {f"TCP {DATABASE}": f"process {DATABASE}: "}, "the operator reads what bypasses it"


def test_a_node_whose_connection_to_the_master_was_cut_is_a_node_at_the_next_cut(machine: Machine) -> None:
    """rospy opens another connection only for its next call, which may never come."""
    machine.begin(Phase.TAKING)
    machine.order("cut", ports=[NODE])
    machine.connected.clear()
    for work in (machine.work, AdoptWork(machine.state)):
        machine.work = work
        assert machine.order("cut", ports=[NODE])["kept"] == {}
    save_record(machine.state, msgspec.structs.replace(machine.record, boot="another"))
    assert machine.record.nodes == (), "another process may have the number"


def test_a_full_disk_prevents_no_cut(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    machine.begin(Phase.TAKEN)

    def full(*_arguments: object) -> None:
        raise NetworkError("adopt.json cannot be written: No space left on device")

    monkeypatch.setattr(machine_side, "save_record", full)
    assert machine.order("cut", ports=[NODE]) == {"master": 1, "nodes": 1, "kept": {}}


def test_the_cuts_of_a_taking_and_of_a_taken_graph_are_bounded(machine: Machine) -> None:
    machine.begin(Phase.TAKING)
    for _ in range(60):
        machine.order("cut", ports=[NODE])
    with pytest.raises(ValueError, match="more than 60 cuts"):
        machine.order("cut", ports=[NODE])
    machine.order("phase", phase=Phase.TAKEN)
    before = len(machine.refused)
    assert machine.order("cut", ports=[NODE]) == {"master": 0, "nodes": 0, "kept": {}}, (
        "the last cut still refuses"
    )
    machine.time.advance(60.0)
    assert machine.order("cut", ports=[NODE]) == {"master": 1, "nodes": 1, "kept": {}}
    assert len(machine.refused) == before + 1


def test_a_foreign_master_is_foreign_until_the_graph_is_given_back() -> None:
    facts = MachineFacts(
        AdoptRecord(phase=Phase.TAKEN, unit="roscore.service", user="robot", program="/usr/bin/rosmaster"), "", "",
        master=msgspec.structs.replace(MASTER, user="mallory"),
    )  # fmt: skip
    assert "user mallory) is not the recorded master" in facts.foreign_master
    free = msgspec.structs.replace(facts, record=msgspec.structs.replace(facts.record, phase=Phase.FREE))
    assert free.foreign_master == ""


STAND_IN = msgspec.structs.replace(MASTER, pid=8, unit="rosrv-left-master.service")


@pytest.mark.parametrize("boot", ["this", "next"])
@pytest.mark.parametrize(
    ("first", "next_boot"),
    [
        (MASTER, MASTER),
        (msgspec.structs.replace(MASTER, unit=""), MASTER),
        *(
            (msgspec.structs.replace(MASTER, unit=one), msgspec.structs.replace(MASTER, unit=other))
            for one, other in (
                ("session-3.scope", "session-5.scope"),
                ("vte-spawn-1f.scope", "vte-spawn-2e.scope"),
                ("docker-1f.scope", "docker-2e.scope"),
                ("run-u17.service", "run-u4.service"),
                ("run-r1f2e.service", "run-r2e1f.service"),
                ("session-3.scope", "roscore.service"),
            )
        ),
        (STAND_IN, MASTER),
    ],
    ids=lambda master: master.unit,
)
def test_the_recorded_master_is_the_same_after_a_login_a_boot_and_a_release(
    first: RobotMaster, next_boot: RobotMaster, boot: str
) -> None:
    earlier = AdoptRecord(boot="this", user="root", unit="roscore.service", program=MASTER.program)
    for before in (AdoptRecord(boot="this"), msgspec.structs.replace(earlier, stand_in=STAND_IN.pid)):
        stands_in = first is STAND_IN and before.stand_in
        record = wanted_record(before, first).now(boot)
        later = msgspec.structs.replace(next_boot, pid=20, user="root" if stands_in else first.user)
        there = first if boot == "this" else later
        assert MachineFacts(record, "", "", master=there).foreign_master == ""
        for changed in ({"user": "mallory"}, {"program": "/tmp/master", "unit": "another.service"}):
            other = msgspec.structs.replace(there, pid=21, **changed)
            assert MachineFacts(record, "", "", master=other).foreign_master


def test_other_machines_wait_for_a_graph_until_it_is_released(machine: Machine) -> None:
    work = AdoptWork(machine.state)
    for phase, wanted, waits in (
        (Phase.FREE, True, True),
        (Phase.TAKEN, False, True),
        (Phase.FREE, False, False),
    ):
        machine.begin(phase, wanted=wanted)
        assert work.takes_over(), "it stays for the life of this supervisor"
        assert work.wants() is waits
        settings = IsolationSettings(ports=(PortRange.one(20_000),), master=11311, wants=work.wants)
        assert Isolation(Namespace.own(), settings).awaits_graph is waits
