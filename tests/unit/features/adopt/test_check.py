import asyncio
import ipaddress
import json
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
from typer import Exit

from appliance.base.shipped import SHIPPED
from appliance.channel.admin import AdminAnswer, PolicyReload
from appliance.cli.connection.target import Appliance
from appliance.cli.standing import NotStandingError
from appliance.configuration.settings import Settings
from appliance.features.adopt import adopt_check, adopt_verb, release_verb
from appliance.features.adopt.adopt_answers import AdoptState, GiveBackReport, TakeOverReport
from appliance.features.adopt.adopt_check import CheckedRobot, CheckLine, graph_lines
from appliance.features.adopt.adopt_record import AdoptRecord, Phase, boot_id, load_record, save_record
from appliance.features.adopt.machine_facts import MachineFacts, RobotMaster
from appliance.features.adopt.machine_side import wanted_record
from appliance.features.adopt.places import NodePlace
from appliance.features.adopt.release_verb import release_dead
from appliance.features.adopt.requests import AdoptStatus, ReleaseOrder
from appliance.features.adopt.robot_side import AUDIT_ONLY, make_audit_only
from appliance.features.adopt.takeover import AdoptError, AdoptOperation
from appliance.network import close_ports
from appliance.network.listening_sockets import TcpSocket
from appliance.network.namespaces import NetworkError
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.graph_inventory import GraphInventory, SurveyedNode, SurveyedService, SurveyedTopic
from appliance.store.state_file import StateStore
from roswire.uris import NodeUri
from tests.support.answers import example
from tests.support.engines import InlineDatabase
from tests.support.memory_call import call_of

MASTER = RobotMaster(1, "/usr/bin/rosmaster", "robot", "roscore.service", "system.slice/roscore.service")
LINK = ipaddress.ip_address("10.111.0.1")
DEFAULT = (SHIPPED / "policies" / "default.ini").read_text()


def socket(port: int, address: str = "0.0.0.0", *, listens: bool = True) -> TcpSocket:
    return TcpSocket(
        4, address, port, "0.0.0.0", 0, listens=listens, established=not listens, inode=str(port)
    )


def robot(policy: str = DEFAULT, *nodes: SurveyedNode, sockets: tuple[TcpSocket, ...] = ()) -> CheckedRobot:
    inventory = GraphInventory(
        "http://127.0.0.1:11311", "127.0.0.1",
        nodes or (SurveyedNode("/base", "http://base:4001/", "192.168.50.1"),),
        (SurveyedTopic("/odom", "nav_msgs/Odometry", ("/base",)),),
        (SurveyedService("/reset", ("/base",), "rosrpc://base:5001"),), ("/speed",),
    )  # fmt: skip
    return CheckedRobot(
        11311, AdoptRecord(), MASTER, inventory, frozenset({"192.168.50.1"}), (socket(4001), *sockets),
        compile_policy(policy, file="policy.ini", robot=[LINK]), LINK, frozenset({4001, 4002}),
    )  # fmt: skip


def lines(state: CheckedRobot) -> dict[str, CheckLine]:
    return {line.about: line for line in graph_lines(state)}


def test_a_robot_that_can_be_adopted_has_no_stop() -> None:
    found = lines(robot())
    assert {line.level for line in found.values()} == {"ok"}
    assert found["master"].text.startswith("/usr/bin/rosmaster (roscore.service), 1 node, 1 topic, 1 service")
    assert found["policy"].text == "0 of 2 registrations would be denied"


def test_a_robot_without_a_master_or_with_another_program_stops() -> None:
    assert lines(replace(robot(), master=None))["master"].level == "stop"
    assert lines(replace(robot(), inventory=None))["master"].level == "stop"


@pytest.mark.parametrize(
    ("unit", "programs", "level", "text"),
    [
        ("roscore@pi.service", [], "warn", "not directly in system.slice"),  # in system-roscore.slice
        ("core.service", ["/bin/bash /root/start.sh", "python3 /opt/ros/noetic/bin/roscore"], "warn", "by a script"),
        ("robot.service", ["/bin/bash /root/start.sh", "python3 /opt/ros/noetic/bin/roslaunch a b"], "ok", "other"),
        ("robot.service", ["roslaunch robot.launch", "rosmaster --core"], "ok", "and other programs"),
        ("session-3.scope", [], "ok", "and other programs"),
    ],
)  # fmt: skip
def test_a_roscore_that_no_drop_in_can_help_must_not_restart(
    monkeypatch: pytest.MonkeyPatch, unit: str, programs: list[str], level: str, text: str
) -> None:
    monkeypatch.setattr(adopt_check, "programs_of_unit", {unit: programs}.__getitem__)
    found = list(
        adopt_check.unit_lines(replace(robot(), master=RobotMaster(1, "/usr/bin/rosmaster", "robot", unit)))
    )
    assert [(line.level, text in line.text) for line in found] == [(level, True)]


@pytest.mark.parametrize(
    ("node", "listeners", "about", "level"),
    [
        (SurveyedNode("/far", "http://nuc:4002/"), (), "hosts", "warn"),
        (SurveyedNode("/lo", "http://localhost:4002/", "127.0.0.1"), (socket(4002),), "nodes", "stop"),
        (SurveyedNode("/lo", "http://base:4002/", "127.0.1.1"), (socket(4002, "127.0.0.1"),), "nodes", "stop"),
        (SurveyedNode("/gone", "http://base:4002/", "192.168.50.1", problem="refuses"), (), "nodes", "warn"),
        (SurveyedNode("/other", "http://nuc:4002/", "192.168.50.2"), (), "hosts", "warn"),
    ],
)  # fmt: skip
def test_a_node_that_cannot_be_moved_is_named(
    node: SurveyedNode, listeners: tuple[TcpSocket, ...], about: str, level: str
) -> None:
    found = lines(robot(DEFAULT, node, sockets=listeners))[about]
    assert found.level == level
    assert node.name in found.text or node.host in found.text


def test_names_of_an_unknown_host_stop_no_adoption() -> None:
    """Neither unknown hosts, nor ports of other programs of this machine, nor more names than can be read."""
    strangers = (
        *(SurveyedNode(f"/a{number}", f"http://a{number}.invalid:4000/") for number in range(520)),
        *(
            SurveyedNode(f"/b{number}", f"http://10.0.0.66:{number}/", "10.0.0.66", problem="late")
            for number in range(300)
        ),
        SurveyedNode("/loopback", "http://localhost:631/", "127.0.0.1"),
        SurveyedNode("/of_a_node", "http://localhost:4001/", "127.0.0.1"),
        SurveyedNode("/nothing", "http://localhost:4999/", "127.0.0.1"),
        SurveyedNode("/odd%s", "odd", problem="not a URI"),
    )
    own = SurveyedNode("/base", "http://base:4001/", "192.168.50.1")
    state = robot(DEFAULT, own, *strangers, sockets=(socket(631, "127.0.0.1"),))
    assert state.inventory is not None
    crowd = tuple(SurveyedTopic(f"/x{number}", "x/X", ("/base", "/b1")) for number in range(300))
    inventory = msgspec.structs.replace(state.inventory, topics=crowd, left_out=("300 of 20300 nodes",))
    found = [*graph_lines(replace(state, inventory=inventory))]
    assert {line.level for line in found} == {"ok", "warn"}
    assert len(found) < 40
    assert max(len(line.text) for line in found) < 600


def test_denied_registrations_are_counted_and_named() -> None:
    denying = DEFAULT.replace("[Publishers]", "[Publishers]\n/odom = 10.9.9.9\n#")
    assert "1 of 2 registrations would be denied: /base /odom" in lines(robot(denying))["policy"].text
    assert lines(robot(denying))["policy"].level == "warn"
    audit_only = lines(robot(denying + AUDIT_ONLY))["policy"]
    assert audit_only == ("ok", "policy", "audit-only: 1 of 2 registrations would be denied")


def test_an_adopted_graph_is_not_judged_by_the_appliances_own_addresses() -> None:
    """There the port of the master leads to RVMaster, by which each node is at the appliance."""
    seen = robot(DEFAULT, SurveyedNode("/base", "http://10.111.0.2:19001/", "10.111.0.2"))
    taken = AdoptRecord(wanted=True, phase=Phase.TAKEN, program=MASTER.program)
    assert [(line.level, line.about) for line in graph_lines(replace(seen, record=taken))] == [
        ("ok", "adopted")
    ]


@pytest.mark.parametrize("listen", ["0.0.0.0:11311", "0.0.0.0:11411"])
def test_a_release_without_the_appliance_looks_for_the_master_on_its_port(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, listen: str
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text(json.dumps({"listen": listen}))
    asked: list[int] = []
    monkeypatch.setattr(release_verb, "master_of", lambda _host, port: asked.append(port))
    machine = release_verb.DeadMachine(
        tmp_path, AdoptRecord(), release_verb.port_of_master(tmp_path), [str(LINK)]
    )
    found = asyncio.run(machine("look"))
    assert asked == [int(listen[-5:])]
    place = NodePlace("http://base:4001/", NodeUri("http", "base", 4001, "/"), LINK)
    assert place.share(msgspec.convert(found, MachineFacts, strict=False)) == "port 4001"


@pytest.mark.parametrize("phase", ["free", "taken"])
def test_a_robot_that_was_never_adopted_is_released_without_a_wait(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], phase: str
) -> None:
    def answer(request: object) -> object:
        if isinstance(request, AdoptStatus):
            return example(AdoptState, phase=phase)
        assert isinstance(request, ReleaseOrder) or phase == "taken"
        return GiveBackReport() if isinstance(request, ReleaseOrder) else AdminAnswer(False, error="down")

    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setattr(release_verb, "show_order", lambda _state, _order: nullcontext())
    monkeypatch.setattr(release_verb, "remove_drop_ins", lambda: None)
    release_verb.release.function(call_of(answer), dead=False, force=False, within=1.0)
    assert capsys.readouterr().out == "nothing is adopted: nodes that use this appliance go on using it\n"


@pytest.mark.parametrize(
    ("record", "released"),
    [
        (AdoptRecord(), True),
        (AdoptRecord(program=MASTER.program), True),
        (AdoptRecord(program=MASTER.program, wanted=True), True),
        (AdoptRecord(program=MASTER.program, wanted=True, phase=Phase.TAKEN), False),
    ],
    ids=["never", "released", "wanted", "taken"],
)
def test_a_release_of_an_appliance_that_waits_lets_other_machines_in(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, record: AdoptRecord, released: bool
) -> None:
    ended: list[bool] = []
    waits = AdminAnswer[Any](False, error="waits: /usr/bin/rosmaster (roscore.service) holds TCP 11311")
    save_record(tmp_path, msgspec.structs.replace(record, boot=boot_id()))
    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setattr(Appliance, "state_here", lambda *_: tmp_path)
    monkeypatch.setattr(release_verb, "remove_drop_ins", lambda: None)
    monkeypatch.setattr(release_verb, "end_hold", lambda: ended.append(True))
    with nullcontext() if released else pytest.raises(Exit):
        release_verb.release.function(call_of(lambda _: waits), dead=False, force=False, within=1.0)
    assert bool(ended) is released
    assert load_record(tmp_path).wanted is (record.wanted and not released)


@pytest.mark.parametrize("as_json", [False, True])
@pytest.mark.parametrize(
    ("report", "status"),
    [
        (GiveBackReport(nodes=3), 0),
        (GiveBackReport(nodes=3, withheld=5, withheld_from="another master"), 1),
        (GiveBackReport(), 0),
    ],
    ids=["given back", "withheld", "nothing adopted"],
)
@pytest.mark.parametrize("closed", [True, False], ids=["closed", "open"])
def test_a_release_names_the_rules_that_still_close_the_nodes(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *,
    report: GiveBackReport,
    status: int,
    closed: bool,
    as_json: bool,
) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setattr(release_verb, "show_order", lambda _state, _order: nullcontext())
    monkeypatch.setattr(release_verb, "remove_drop_ins", lambda: None)
    monkeypatch.setattr(close_ports, "is_applied", lambda: closed)
    with pytest.raises(Exit) if status and not as_json else nullcontext():
        release_verb.release.function(
            call_of(lambda _: report, as_json=as_json), dead=False, force=True, within=1.0
        )
    assert ("sudo rosrv protect --remove" in capsys.readouterr().err) is (closed and report.nodes > 0)


@pytest.mark.parametrize("kind", ["whole", "torn", "empty", "another", "unreadable"])
def test_a_release_without_the_appliance_gives_back_whatever_its_record_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: str
) -> None:
    found: list[MachineFacts] = []

    async def give(operation: AdoptOperation) -> GiveBackReport:
        found.append(await operation.facts())
        if len(found) == 1:
            raise AdoptError("no ROS master can be started")
        await operation.machine("phase", phase=Phase.FREE)
        return GiveBackReport(nodes=3)

    monkeypatch.setattr(AdoptOperation, "give", give)
    monkeypatch.setattr(release_verb, "StateStore", partial(StateStore, kind=InlineDatabase))
    monkeypatch.setattr(release_verb, "master_of", lambda *_: MASTER)
    monkeypatch.setattr(release_verb, "end_hold", lambda: None)
    record = AdoptRecord(
        wanted=True, phase=Phase.TAKEN, boot=boot_id(), program=MASTER.program, unit=MASTER.unit,
        user=MASTER.user,
    )  # fmt: skip
    save_record(tmp_path, record)
    (tmp_path / "control").mkdir()
    (tmp_path / "lock").touch()
    file = tmp_path / "adopt.json"
    if kind == "unreadable":
        file.unlink()
        file.symlink_to(file)
    elif kind != "whole":
        file.write_bytes({"torn": file.read_bytes()[:20], "empty": b"", "another": b"[]"}[kind])
    with pytest.raises(NetworkError, match="no ROS master can be started"):
        asyncio.run(release_dead(tmp_path))
    assert asyncio.run(release_dead(tmp_path)).nodes == 3, "the first attempt has not hidden the graph"
    assert [facts.foreign_master for facts in found] == ["", ""]
    assert load_record(tmp_path).phase is Phase.FREE


def test_connections_that_would_be_cut_are_counted() -> None:
    state = robot(DEFAULT, sockets=(socket(11311, listens=False), socket(5001, listens=False)))
    assert lines(state)["would cut"].text.startswith(
        "1 connection to the master, about 0 connections of topics, 1 at"
    )


def test_only_the_shipped_policy_becomes_audit_only(tmp_path: Path) -> None:
    file = tmp_path / "policy.ini"
    file.write_text(DEFAULT)
    file.chmod(0o640)
    assert make_audit_only(file)
    assert make_audit_only(file), "once more changes nothing"
    assert compile_policy(file.read_text(), file="policy.ini").all_audit_only
    assert file.stat().st_mode & 0o777 == 0o640
    file.write_text(f"{DEFAULT}\n# mine\n")
    assert not make_audit_only(file)
    assert file.read_text() == f"{DEFAULT}\n# mine\n"


@pytest.mark.parametrize(
    ("fails", "lowered"),
    [
        ("standing", False),
        ("reload", False),
        ("order", False),
        ("note", False),
        ("", True),
        ("waits", True),
        ("starts", True),
        ("drop-in", True),
    ],
)
def test_an_adoption_that_fails_leaves_the_policy_as_it_was(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, fails: str, lowered: bool
) -> None:
    """Even before it: nothing was changed while the robot moves. One that is noted goes on."""
    policy, in_force = tmp_path / "policy.ini", [DEFAULT]
    policy.write_text(DEFAULT)

    def answer(request: object) -> object:
        if isinstance(request, PolicyReload):
            if fails == "reload" and policy.read_text() != DEFAULT:
                return AdminAnswer(False, error="the audit log cannot be written")
            in_force.append(policy.read_text())
            return AdminAnswer(True)
        if fails in {"note", "waits", "starts"}:
            return AdminAnswer(False, error="waits: /usr/bin/rosmaster holds TCP 11311")
        return AdminAnswer(False, error="it cannot be read") if fails == "order" else example(TakeOverReport)

    async def stand(*_: object) -> str:
        if fails == "standing":
            assert in_force == [DEFAULT]
            raise NotStandingError("the robot moves")
        return "it stands"

    def drop_in(_record: object) -> None:
        if fails == "drop-in":
            raise NetworkError("50-rosrv-adopt.conf cannot be written")

    def await_start(_appliance: object) -> AdoptState:
        if fails == "starts":
            raise NetworkError("noted, but not adopted within 180 s")
        return example(AdoptState)

    world = {
        "running_settings": lambda _state: Settings(isolation="netns", policy=policy),
        "robot_state": lambda *_: replace(robot(), master=None) if fails == "note" else robot(),
        "check_lines": lambda *_: [], "wait_until_standing": stand, "write_drop_in": drop_in,
        "_await_start": await_start, "link_address": lambda: "",
    }  # fmt: skip
    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setattr(Appliance, "state_here", lambda *_: tmp_path)
    for name, value in world.items():
        monkeypatch.setattr(adopt_verb, name, value)
    options = {"check": False, "status": False, "audit_only": True, "when_standing": True, "within": 1.0}
    with nullcontext() if fails in {"", "waits"} else pytest.raises(Exit):
        adopt_verb.adopt.function(call_of(answer), **options)
    assert policy.read_text() == in_force[-1] == (DEFAULT + AUDIT_ONLY if lowered else DEFAULT)


def test_the_record_survives_and_its_phase_is_of_one_boot(tmp_path: Path) -> None:
    state = tmp_path / "state"
    assert load_record(state) == AdoptRecord(boot=boot_id())
    save_record(state, AdoptRecord(wanted=True, phase=Phase.TAKEN, boot=boot_id()))
    assert load_record(state).phase is Phase.TAKEN
    save_record(state, AdoptRecord(wanted=True, phase=Phase.TAKEN, boot="an earlier one"))
    assert load_record(state) == AdoptRecord(wanted=True, boot=boot_id())
    (state / "adopt.json").write_text("{")
    with pytest.raises(NetworkError, match="release --dead"):
        load_record(state)


def test_the_recorded_master_stays_the_one_of_the_order() -> None:
    record = wanted_record(AdoptRecord(), MASTER)
    assert (record.unit, record.user, record.group) == (MASTER.unit, MASTER.user, MASTER.group)
    assert wanted_record(record, RobotMaster(2, "/tmp/x", "nobody")) is record
    with pytest.raises(NetworkError, match="start the robot first"):
        wanted_record(AdoptRecord(), None)
