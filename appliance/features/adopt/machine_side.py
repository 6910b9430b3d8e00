"""Do the supervisor's part of an adoption: the rules, the end of connections, the robot's own master.

Each piece of work can be repeated: it brings the machine to a state, whatever was done before.

Control orders each step, and is not trusted:

1. An adoption and a release begin with the order of an operator of this machine (`operator_orders.py`).
2. Nodes reach their own master again after a release, or while the appliance ends in order; else no step leads there.
3. Connections end only while a graph is taken, a bounded number of times, and only those of processes that look like
   nodes (`is_node`), to the robot's own master, and to the ports of other machines that control names.
"""

import ipaddress
import math
import os
import pwd
import shutil
import subprocess
import threading
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import msgspec
import structlog

from appliance.base import clock
from appliance.base.host_names import addresses_of
from appliance.features.adopt.adopt_record import AdoptRecord, Phase, load_record, save_record
from appliance.features.adopt.machine_facts import FIRST_PORT, STAND_IN_UNIT, MachineFacts, RobotMaster
from appliance.features.adopt.operator_orders import ADOPT, RELEASE, take_order
from appliance.network import interfaces
from appliance.network.cut import RemotePort, end_connections, refuse_no_port, refuse_ports
from appliance.network.isolation import Isolation
from appliance.network.listening_sockets import TcpSocket
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.port_holders import port_holder
from appliance.network.socket_owners import (
    NodeSockets,
    is_node,
    node_sockets,
    process_key,
    program_of,
    programs_of_unit,
    user_of,
)
from appliance.supervisor.machine_work import Found, Terms
from appliance.supervisor.users import account_of

ROSMASTER = "/usr/bin/rosmaster"
_SYSTEMD = Path("/run/systemd/system")
_MAX_NAMES = _MAX_PORTS = 20_000
_LOOKUP_SECONDS = 0.1
_CALL_SECONDS = 0.25  # of an ordinary service call under way, which is not cut
_START_SECONDS = 10.0
_LOOK_SECONDS = 0.05
_MAX_NODES = 1000  # whose keys are kept, the newest
_MAX_CUTS = 60  # of one taking, which may begin again after kills of control
_CUT_AGAIN_SECONDS = 60.0  # of a graph that is taken; until then the ports of the last cut are refused

log = structlog.get_logger()


def machine(state: Path) -> "AdoptWork":
    return AdoptWork(state)


class AdoptWork:
    """The supervisor's part; see `MachineWork`."""

    def __init__(self, state: Path) -> None:
        self._state = state
        self._took_over = self._ends = False
        self._may_undo = False  # an order to adopt that has not succeeded yet
        self._cuts, self._cut_at = 0, -math.inf

    def takes_over(self) -> bool:
        """Return whether an adoption is wanted or not yet undone, now or earlier in this supervisor's life."""
        self._took_over = self._took_over or self.wants()
        return self._took_over

    def wants(self) -> bool:
        record = load_record(self._state)
        return record.wanted or record.phase is not Phase.FREE

    def holds(self) -> bool:
        """Return whether nodes must not reach their own master, even while the appliance starts again."""
        return load_record(self._state).phase in {Phase.TAKING, Phase.TAKEN}

    def left_alone(self) -> tuple[str, ...]:
        group = load_record(self._state).group
        return (group,) if group else ()

    def nodes(self) -> tuple[str, ...]:
        return load_record(self._state).nodes

    def end(self) -> None:
        self._ends = True

    def carry_out(self, robot_side: Isolation, work: str, terms: Terms) -> Found:
        steps = {
            "look": self._look,
            "want": self._want,
            "phase": self._phase,
            "forward": self._forward,
            "cut": self._cut,
            "stand in": self._stand_in,
            "withdraw": self._withdraw,
            "leave": self._leave,
        }
        if work not in steps:
            raise ValueError(f"adopt does not do {work[:40]!r}")
        if work != "look":
            log.info("control orders a step of an adoption", step=work)
        return steps[work](robot_side, terms)

    # --- facts ---

    def _look(self, side: Isolation, terms: Terms) -> Found:
        ports = _ports(terms.get("ports", []))
        names = msgspec.convert(terms.get("names", []), list[str])[:_MAX_NAMES]
        ends = side.ends[4]
        found = node_sockets(side.host, ports, _master_port(side)) if ports else {}
        facts = MachineFacts(
            record=load_record(self._state),
            link=ends.host,
            appliance=ends.appliance,
            own=[text.partition("/")[0] for text in interfaces.addresses(side.host)],
            master=master_of(side.host, _master_port(side)),
            reaches={port: one.master_address for port, one in found.items() if one.master_address},
            sockets={port: sorted(socket.listening) for port, socket in found.items()},
            resolved=addresses_of(names, side.host.popen),
        )
        return dict(msgspec.to_builtins(facts))

    # --- the record ---

    def _want(self, side: Isolation, terms: Terms) -> Found:
        wanted = msgspec.convert(terms["wanted"], bool)
        record = load_record(self._state)
        if wanted == record.wanted:
            return {}
        if wanted:
            self._require(take_order(self._state, ADOPT), "no operator ordered an adoption")
            master = master_of(side.host, _master_port(side))
            record = wanted_record(record, master)
        else:
            may = self._may_undo or take_order(self._state, RELEASE)
            self._require(may, "no operator ordered a release")
            record = msgspec.structs.replace(record, wanted=False)
        self._may_undo = wanted
        save_record(self._state, record)
        self.takes_over()
        return {}

    def _phase(self, _side: Isolation, terms: Terms) -> Found:
        phase, record = msgspec.convert(terms["phase"], Phase), load_record(self._state)
        before = {
            Phase.TAKING: {*Phase} if record.wanted else set[Phase](),
            Phase.TAKEN: {Phase.TAKING, Phase.TAKEN} if record.wanted else set[Phase](),
            Phase.GIVING: set[Phase](),  # only by `withdraw`
            Phase.GIVEN: {Phase.GIVING, Phase.GIVEN},
            Phase.FREE: {Phase.GIVEN, Phase.FREE},
        }
        self._require(record.phase in before[phase], f"{record.phase} does not become {phase}")
        if phase is Phase.TAKING and record.phase is not phase:
            self._cuts = 0
        if phase is Phase.TAKEN:
            self._may_undo = False
        self._note(phase)
        return {}

    @staticmethod
    def _require(allowed: bool, why: str) -> None:
        if not allowed:
            raise ValueError(f"control ordered a step that does not follow from an operator's order: {why}")

    def _require_giving(self) -> None:
        record = load_record(self._state)
        self._require(not record.wanted or self._ends, "no release, and no end of the appliance")
        self._require(record.phase is not Phase.FREE, "nothing is adopted")

    def _note(self, phase: Phase) -> None:
        record = load_record(self._state)
        if record.phase is not phase:
            save_record(self._state, msgspec.structs.replace(record, phase=phase))

    # --- taking ---

    def _forward(self, side: Isolation, _terms: Terms) -> Found:
        self._require_taking()
        self.takes_over()
        side.forward_master()
        return {}

    def _require_taking(self) -> Phase:
        record = load_record(self._state)
        taking = record.wanted and record.phase in {Phase.TAKING, Phase.TAKEN}
        self._require(taking, "no graph is taken over")
        return record.phase

    def _may_cut(self, phase: Phase, removed_at: float) -> bool:
        """Return whether connections may end now; False soon after the last cut of a graph that is taken.

        After a removal of the rules at `removed_at` they may end once more.
        """
        if (
            phase is Phase.TAKEN
            and removed_at < self._cut_at
            and clock.now() - self._cut_at < _CUT_AGAIN_SECONDS
        ):
            return False
        if phase is Phase.TAKING:
            self._require(self._cuts < _MAX_CUTS, f"more than {_MAX_CUTS} cuts of one adoption")
            self._cuts += 1
        self._cut_at = clock.now()
        return True

    def _cut(self, side: Isolation, terms: Terms) -> Found:
        phase = self._require_taking()
        ports = set(_ports(terms.get("ports", [])))
        remote = {
            RemotePort(str(ipaddress.IPv4Address(address)), port)
            for address, port in msgspec.convert(terms.get("remote", []), list[tuple[str, int]])[:_MAX_PORTS]
        }
        master, appliance = _master_port(side), side.ends[4].appliance
        if any(port < FIRST_PORT or port == master for port in {*ports, *(one.port for one in remote)}):
            raise ValueError("a port of the machine itself is not a port of a node")
        sockets = node_sockets(side.host, ports, master)
        known = self._known_nodes(sockets.values())
        others = {port: socket.pid for port, socket in sockets.items() if not is_node(socket, known)}
        kept = {f"TCP {port}": f"process {pid}: {program_of(pid)}" for port, pid in sorted(others.items())}
        if not self._may_cut(phase, side.removed_at):
            return {"master": 0, "nodes": 0, "kept": kept}
        if others:
            log.warning("connections of processes that do not look like nodes are not cut", ports=kept)
        ports -= others.keys()

        def of_master(socket: TcpSocket) -> bool:
            return socket.port == master and socket.peer_address != appliance

        def of_nodes(socket: TcpSocket) -> bool:
            if socket.port in ports:
                return socket.peer_address != appliance
            return (socket.peer_address, socket.peer_port) in remote

        calls = end_connections(side.host, of_master)
        threading.Event().wait(
            _LOOKUP_SECONDS
        )  # a client of a service uses the address that it has looked up
        refuse_ports(side.host, side.settings.link, ports, remote)
        nodes = end_connections(side.host, of_nodes, lasting=_CALL_SECONDS)
        return {"master": calls, "nodes": nodes, "kept": kept}

    def _known_nodes(self, found: Iterable[NodeSockets]) -> tuple[str, ...]:
        """Return the keys of processes that are, or were at an earlier cut, connected to a master."""
        record = load_record(self._state)
        connected = {process_key(one.pid) for one in found if one.master_address} - {*record.nodes, ""}
        if connected:
            record = msgspec.structs.replace(record, nodes=(*record.nodes, *sorted(connected))[-_MAX_NODES:])
            try:
                save_record(self._state, record)
            except NetworkError as error:  # a full disk prevents no cut
                log.warning("the nodes of this cut are not remembered", reason=str(error))
        return record.nodes

    # --- giving back ---

    def _stand_in(self, side: Isolation, _terms: Terms) -> Found:
        """Have a master on the robot's port: its own, or one that outlives the appliance."""
        self._require_giving()
        port = _master_port(side)
        if master_of(side.host, port) is not None:
            return {"started": False}
        record = load_record(self._state)
        stand_in = start_stand_in(side.host, port, record)
        save_record(self._state, msgspec.structs.replace(record, stand_in=stand_in))
        return {"started": True}

    def _withdraw(self, side: Isolation, _terms: Terms) -> Found:
        self._require_giving()
        self._note(Phase.GIVING)
        refuse_no_port(
            side.host
        )  # first: a node that asks its own master next gets an address that it may use
        side.withdraw_master()
        master = _master_port(side)
        return {"master": end_connections(side.namespace, lambda one: one.port == master)}

    def _leave(self, side: Isolation, _terms: Terms) -> Found:
        self._require(load_record(self._state).phase is Phase.GIVEN, "the graph is not given back")
        ranges, robot = side.settings.ports, {ends.host for ends in side.ends.values()}

        def of_nodes(socket: TcpSocket) -> bool:
            return any(span.first <= socket.port <= span.last for span in ranges if span.first != span.last)

        ended = end_connections(side.namespace, of_nodes, lasting=_CALL_SECONDS)
        log.info("the graph is given back", connections=ended, robot=sorted(robot))
        return {"nodes": ended}


def wanted_record(record: AdoptRecord, master: RobotMaster | None) -> AdoptRecord:
    """Return the record of a wanted adoption of the graph of `master`. Raises `NetworkError` without a master.

    Keep the recorded master if an adoption is already wanted, or if a stand-in has the graph.
    """
    if record.wanted:
        return record
    if master is None:
        raise NetworkError("no ROS master of the robot is running: start the robot first")
    record = msgspec.structs.replace(
        record, wanted=True, since_utc=clock.utc_now().isoformat(timespec="seconds")
    )
    if record.program and master.pid == record.stand_in:
        return record
    return msgspec.structs.replace(
        record, unit=master.unit, user=master.user, program=master.program, group=master.group
    )


def master_of(host: Namespace, port: int) -> RobotMaster | None:
    """Return the program of the robot that listens on the port of the master; None without one."""
    holder = host.run(lambda: port_holder(port))
    if holder is None:
        return None
    lines = programs_of_unit(holder.unit) if holder.unit else []
    group = f"system.slice/{holder.unit}" if lines and all(map(of_roscore, lines)) else ""
    return RobotMaster(holder.pid, holder.program, user_of(holder.pid), holder.unit, group)


def of_roscore(line: str) -> bool:
    """Return whether a process belongs to roscore: roslaunch in its role, rosmaster, rosout."""
    words = [os.path.basename(word) for word in line.split()]  # noqa: PTH119  words, not paths
    return not words or any(word in {"roscore", "rosmaster", "rosout"} for word in words[:3])


def start_stand_in(host: Namespace, port: int, record: AdoptRecord) -> int:
    """Start a ROS master that outlives the appliance, and return its process once it listens. Raises `NetworkError`."""
    user, uid, gid = _stand_in_user(record.user)
    command = [ROSMASTER, "--core", "-p", str(port)]
    if _SYSTEMD.is_dir() and (run := shutil.which("systemd-run")):
        unit = [run, "--quiet", "--collect", f"--unit={STAND_IN_UNIT}", f"--uid={uid}", f"--gid={gid}"]
        started = subprocess.run(
            [*unit, "--setenv=ROS_LOG_DIR=/tmp", "--", *command],
            capture_output=True,
            text=True,
            timeout=_START_SECONDS,
            check=False,
        )
        if started.returncode:
            raise NetworkError(f"systemd-run started no ROS master: {started.stderr.strip()[:300]}")
    else:
        host.popen(
            command, user=uid, group=gid, extra_groups=[], start_new_session=True,
            env={"PATH": os.environ.get("PATH", "/usr/bin:/bin"), "ROS_LOG_DIR": "/tmp"}, cwd="/",  # noqa: S108  only a log
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    until, pause = clock.now() + _START_SECONDS, threading.Event()
    while (holder := host.run(lambda: port_holder(port))) is None:
        if clock.now() > until:
            raise NetworkError(f"{ROSMASTER} does not listen on TCP {port}: journalctl has its output")
        pause.wait(_LOOK_SECONDS)
    log.warning("a ROS master was started for the robot", unit=STAND_IN_UNIT, user=user, port=port)
    return holder.pid


def _stand_in_user(recorded: str) -> tuple[str, int, int]:
    """Return the user of the robot's own master, unless that is root or unknown: then that of the hidden one."""
    with suppress(KeyError):
        entry = pwd.getpwnam(recorded)
        if entry.pw_uid:
            return recorded, entry.pw_uid, entry.pw_gid
    account = account_of("rosmaster")
    return account.name, account.uid, account.gid


def _master_port(side: Isolation) -> int:
    assert side.settings.master is not None  # noqa: S101  the isolation of an appliance has it
    return side.settings.master


def _ports(given: object) -> list[int]:
    ports = msgspec.convert(given, list[int])
    if len(ports) > _MAX_PORTS or any(not 0 < port < 65_536 for port in ports):
        raise ValueError("not a list of ports")
    return ports
