"""Look at a robot before its graph is taken over: what would change, and what would stop it. Nothing is changed."""

import os
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Literal, NamedTuple
from urllib.parse import urlsplit

from appliance.base.counted import counted
from appliance.features.adopt.adopt_record import AdoptRecord, Phase
from appliance.features.adopt.machine_facts import RobotMaster
from appliance.features.adopt.machine_side import of_roscore
from appliance.network.cut import can_end_connections
from appliance.network.firewall.nft import NftBackend
from appliance.network.listening_sockets import TcpSocket, tcp_sockets
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.socket_owners import programs_of_unit
from appliance.policy.model import Address
from appliance.policy.policy import Policy
from appliance.policy.rights import decide, request_of, rights_of_call
from appliance.rpc.graph_inventory import GraphInventory, SurveyedNode, problems

Level = Literal["ok", "warn", "stop"]
_CGROUPS = Path("/sys/fs/cgroup/cgroup.controllers")
_SHOWN = 5
_MAX_PROBLEMS = 20
_SYSTEMCTL_SECONDS = 5.0
_SHELLS = {"sh", "dash", "bash", "zsh"}
_DEPENDS = ("RequiredBy", "BoundBy", "ConsistsOf")


class CheckLine(NamedTuple):
    """A line of the check. With `stop` the graph is not taken over."""

    level: Level
    about: str
    text: str


@dataclass(frozen=True)
class CheckedRobot:
    """Everything that a check reads: the master, the graph, the machine's sockets, the policy that will decide."""

    port: int
    record: AdoptRecord
    master: RobotMaster | None
    inventory: GraphInventory | None
    own: frozenset[str]
    sockets: tuple[TcpSocket, ...]
    policy: Policy | None
    robot: Address
    """The address of the robot in the policy's group `robot`."""
    node_ports: frozenset[int] = frozenset()
    """The ports of this machine's processes that look like nodes."""

    def is_here(self, node: SurveyedNode) -> bool:
        return bool(node.host) and (ip_address(node.host).is_loopback or node.host in self.own)


def check_lines(state: CheckedRobot, host: Namespace) -> list[CheckLine]:
    """Return all lines, of the graph and of the machine."""
    return [*graph_lines(state), *machine_lines(state, host)]


def graph_lines(state: CheckedRobot) -> Iterator[CheckLine]:
    if state.record.phase is Phase.TAKEN:  # the master's port leads to RVMaster, which hides the nodes' hosts
        yield _adopted(state)
        return
    yield from _master(state)
    if state.master is None or state.inventory is None:
        return
    yield from _nodes(state, state.inventory)
    yield from _policy(state, state.inventory)
    yield _cuts(state, state.inventory)
    found = [one for one in problems(state.inventory) if " cannot be asked: " not in one]
    for problem in found[:_MAX_PROBLEMS]:
        yield CheckLine("warn", "graph", problem)
    if len(found) > _MAX_PROBLEMS:
        text = f"{len(found) - _MAX_PROBLEMS} more problems of the graph: rosrv survey lists them"
        yield CheckLine("warn", "graph", text)


def _adopted(state: CheckedRobot) -> CheckLine:
    text = f"since {state.record.since_utc}, from {state.record.program}; nodes: rosrv adopt --status"
    return CheckLine("ok", "adopted", text)


def _master(state: CheckedRobot) -> Iterator[CheckLine]:
    if state.record.wanted:
        yield _adopted(state)
    if state.master is None:
        level: Level = "ok" if state.record.wanted else "stop"
        yield CheckLine(level, "master", f"no program listens on TCP {state.port}: start the robot first")
        return
    if state.inventory is None:
        yield CheckLine(
            "stop", "master", f"{state.master} holds TCP {state.port}, and does not answer as a ROS master"
        )
        return
    inventory = state.inventory
    hosts = _some(filter(None, {node.host for node in inventory.nodes}))
    numbers = ", ".join((
        counted(len(inventory.nodes), "node"), counted(len(inventory.topics), "topic"),
        counted(len(inventory.services), "service"), counted(len(inventory.parameters), "parameter"),
    ))  # fmt: skip
    yield CheckLine("ok", "master", f"{state.master}, {numbers}, hosts {hosts or 'none'}")
    for left in inventory.left_out:
        yield CheckLine("warn", "master", f"not all of the graph was read: {left}")


def _nodes(state: CheckedRobot, inventory: GraphInventory) -> Iterator[CheckLine]:
    asked = [node for node in inventory.nodes if node.name != "/rosout"]
    unplaced = {node.name: _host_in(node.uri) for node in asked if node.uri and not node.host}
    unknown = list(unplaced)
    loopback = _on_loopback(state, asked)
    gone = [node.name for node in asked if node.problem and node.name not in {*unknown, *loopback}]
    if unknown:
        yield CheckLine(
            "warn",
            "hosts",
            f"{_some(unplaced.values())}, the host of {_some(unknown)}, is not known here, and its nodes stay with"
            " their own master: add its address to /etc/hosts if it belongs to the robot",
        )
    if loopback:
        text = (
            f"{_some(loopback)} announce a loopback address, or listen there only, where the appliance cannot call"
            " them: start them without"
            " ROS_HOSTNAME=localhost or ROS_IP=127.0.0.1"
        )
        yield CheckLine("stop", "nodes", text)
    if gone:
        yield CheckLine(
            "warn", "nodes", f"{_some(gone)} do not answer, and stay with their own master: rosnode cleanup"
        )
    elsewhere = sorted({node.host for node in asked if node.host and not state.is_here(node)})
    if elsewhere:
        text = (
            f"other computers: {_some(elsewhere)}. Connections among them are not cut, and their nodes' ports stay"
            " open to every host: `rosrv protect`"
        )
        yield CheckLine("warn", "hosts", text)


def _on_loopback(state: CheckedRobot, nodes: Iterable[SurveyedNode]) -> list[str]:
    """Return the nodes of this machine that the appliance cannot call.

    Any host may have registered a name with a port of this machine. So the process must look like a node, and none of
    its names may have an address that the appliance can call.
    """
    bound: dict[int, set[str]] = {}
    for socket in state.sockets:
        if socket.listens:
            bound.setdefault(socket.port, set()).add(socket.local_address)
    found, callable_ports = dict[str, int](), set[int]()
    for node in nodes:
        with suppress(ValueError):
            port = int(node.uri.rstrip("/").rpartition(":")[2])
            if not state.is_here(node) or port not in state.node_ports & bound.keys():
                continue
            only = all(ip_address(address).is_loopback for address in bound[port])
            if only or node.uri.startswith(("http://localhost:", "http://127.")):
                found[node.name] = port
            else:
                callable_ports.add(port)
    return [name for name, port in found.items() if port not in callable_ports]


def denied_registrations(
    state: CheckedRobot, policy: Policy, inventory: GraphInventory
) -> tuple[list[str], int]:
    """Return the registrations that the policy would deny, and the number of all."""
    hosts = {node.name: _seen_as(state, node) for node in inventory.nodes}
    wanted = [
        ("registerPublisher", topic.name, name) for topic in inventory.topics for name in topic.publishers
    ]
    wanted += [
        ("registerSubscriber", topic.name, name) for topic in inventory.topics for name in topic.subscribers
    ]
    wanted += [("registerService", one.name, name) for one in inventory.services for name in one.providers]
    wanted = [row for row in wanted if row[2] != "/rosout"]
    denied = []
    for call, resource, name in wanted:
        host = hosts.get(name)
        if host is None:
            continue
        decision = decide(policy, rights_of_call(request_of(call, host, name, resource), call, resource))
        if not decision.allowed or decision.would_deny:
            denied.append(f"{name} {resource}")
    return denied, len(wanted)


def _seen_as(state: CheckedRobot, node: SurveyedNode) -> Address | None:
    if not node.host:
        return None
    return state.robot if state.is_here(node) else ip_address(node.host)


def _policy(state: CheckedRobot, inventory: GraphInventory) -> Iterator[CheckLine]:
    if state.policy is None:
        yield CheckLine(
            "warn", "policy", "the policy is not known, because the appliance does not run or wait yet"
        )
        return
    denied, number = denied_registrations(state, state.policy, inventory)
    text = f"{len(denied)} of {counted(number, 'registration')} would be denied"
    if state.policy.all_audit_only:
        yield CheckLine("ok", "policy", f"audit-only: {text}")
    elif denied:
        yield CheckLine(
            "warn", "policy", f"{text}: {_some(denied)}; `--audit-only` records denials and lets them pass"
        )
    else:
        yield CheckLine("ok", "policy", text)


def _cuts(state: CheckedRobot, inventory: GraphInventory) -> CheckLine:
    ports = _service_ports(inventory)
    established = [socket for socket in state.sockets if socket.established]
    master = sum(one.port == state.port for one in established)
    links = {
        row for node in inventory.nodes for row in node.connections if row.connected and row.direction == "i"
    }
    persistent = sum(one.port in ports for one in established)
    text = (
        f"{counted(master, 'connection')} to the master, about {counted(len(links), 'connection')} of topics,"
        f" {persistent} at ports of services: each client of a persistent service sees one failed call."
        " Nothing restarts"
    )
    return CheckLine("ok", "would cut", text)


def _service_ports(inventory: GraphInventory) -> set[int]:
    ports = set()
    for service in inventory.services:
        with suppress(ValueError):
            ports.add(int(service.uri.rstrip("/").rpartition(":")[2]))
    return ports


def machine_lines(state: CheckedRobot, host: Namespace) -> Iterator[CheckLine]:
    if not can_end_connections(host):
        yield CheckLine("stop", "kernel", "connections cannot be ended: CONFIG_INET_DIAG_DESTROY is missing")
    try:
        for chain in NftBackend(host).foreign_forward_drops():
            text = (
                f"{chain} drops forwarded packets by default: let interface veth-rosrv pass in it, both ways"
            )
            yield CheckLine("warn", "firewall", text)
    except NetworkError as error:
        yield CheckLine("stop", "firewall", str(error))
    yield from unit_lines(state)


def unit_lines(state: CheckedRobot) -> Iterator[CheckLine]:
    master = state.master
    if master is None or not master.unit:
        return
    if not master.group and (why := _why_no_drop_in(master.unit)):
        text = f"{master.unit} {why}, so no drop-in keeps it working: it must not restart while the graph is adopted"
        yield CheckLine("warn", "units", text)
        return
    if not master.group:
        text = f"{master.unit} has its own master and other programs; if it restarts, a release starts another master"
        yield CheckLine("ok", "units", text)
        return
    needs = depending_units(master.unit)
    who = f"{', '.join(needs)} {'need' if len(needs) > 1 else 'needs'} {master.unit}; " if needs else ""
    if _CGROUPS.exists():
        yield CheckLine("ok", "units", f"{who}a drop-in keeps {master.unit} working beside the appliance")
    else:
        text = f"{who}without control groups v2, {master.unit} must not restart while the graph is adopted"
        yield CheckLine("warn", "units", text)


def _why_no_drop_in(unit: str) -> str:
    """Return why a unit without other programs than `roscore` gets no drop-in; empty for a unit with others."""
    if not unit.endswith(".service"):
        return ""
    programs = programs_of_unit(unit)
    others = [line.split()[0] for line in programs if not of_roscore(line)]
    if any(os.path.basename(program) not in _SHELLS for program in others):  # noqa: PTH119  words, not paths
        return ""
    return "starts roscore by a script, and not by `exec`" if programs else "is not directly in system.slice"


def depending_units(unit: str) -> list[str]:
    """Return the units that stop or restart with this one."""
    systemctl = shutil.which("systemctl")
    if systemctl is None:
        return []
    with suppress(OSError, subprocess.TimeoutExpired):
        shown = subprocess.run(
            [systemctl, "show", "--property", ",".join(_DEPENDS), "--", unit],
            capture_output=True, text=True, timeout=_SYSTEMCTL_SECONDS, check=False,
        )  # fmt: skip
        values = (line.partition("=")[2] for line in shown.stdout.splitlines())
        return sorted({name for value in values for name in value.split() if name.endswith(".service")})
    return []


def sockets_of(host: Namespace) -> tuple[TcpSocket, ...]:
    return tuple(host.run(tcp_sockets))


def _host_in(uri: str) -> str:
    with suppress(ValueError):  # the node chose the text
        return urlsplit(uri).hostname or uri
    return uri


def _some(names: Iterable[str]) -> str:
    listed = sorted(set(names))
    more = len(listed) - _SHOWN
    return ", ".join(listed[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
