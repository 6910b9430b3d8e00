"""Losses and returns of nodes, and of each process of the appliance.

After the last one, the whole deployment is as it was before the first: what nodes are connected to, the stored state,
what each quota counts, the alarms, and the threads and open files of each process. ROSRV_LOSSES is the number of each.
"""

import contextlib
import json
import os
import re
import signal
import socket
import sqlite3
import subprocess
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from websockets.sync.client import connect

from appliance.features.approvals.quotas import APPROVALS
from appliance.features.approvals.requests import Approval, ApprovalsWanted, ApproveCall, RefuseCall
from appliance.network import interfaces
from appliance.supervisor.process_slot import STABLE_SECONDS
from examples.landshark.lab import Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.rosmaster import call_on, master_at
from tests.support.translators import TRANSLATORS, guest_behind
from tests.support.waiting import eventually

_REST_SECONDS = 45.0  # a node that unregistered is forgotten after half a minute
LOSSES = int(os.environ.get("ROSRV_LOSSES", "20"))
OWN, ROBOT, GUEST = "10.77.0.2", "10.77.0.10", "10.77.0.66"
POLICY = f"""
[Groups]
site = 10.77.0.0/24
agent = door:agent
[Nodes]
default = site agent
[Publishers]
default = site
/held/** = {ROBOT}, ask {GUEST}
[Subscribers]
default = site agent
[Services]
default = site
[Clients]
default = site agent
[Commands]
default = site agent
[Parameters]
read default = site agent
write default = site
[Authority]
base = /cmd
take base = {GUEST}
override base = {ROBOT}
lease base = 2s
"""
SETTINGS = (
    "{api_networks: [10.77.0.0/24], liveness: {silent: 10, shadow: 5}}"  # so long a killed node is kept
)
_STATUS = (
    "probe", "rosmaster", "relay", "nodes", "shadows", "topics", "services", "connections",
    "switched_off", "blocks",
)  # fmt: skip
_KEPT = {
    "incarnation WHERE name NOT LIKE '/door_%'": "name, host, life",  # a door has its node from the first client on
    "registration WHERE kind != 'parameter'": "kind, resource",  # roscpp asks for one when it needs it
    "permission WHERE kind = 'topic'": "resource, host, caller_id",  # no call tells that a client of a service ended
    "parameter_owner": "key",
    "token WHERE revoked IS NULL": "name",
    "door": "name, removed",
    "door_ticket": "door",
    "host_block": "*",
    "monitor_state": "relay",
    "ends": "kind, name",
}
"""The columns of the state that a loss and its return must leave as they were."""


class Site(NamedTuple):
    appliance: Appliance
    lab: Lab
    robot: RosSession
    guest: RosSession
    behind: RosSession  # on a guest whose host translates its address
    nodes: dict[str, Process]

    def restart(self, name: str, number: int) -> None:
        """End a node by a signal, and start it again under its name."""
        node = self.nodes[name]
        os.kill(node.pid, number)
        node.popen.wait(timeout=30)
        self.nodes[name] = _node(self, name)

    def hears(self) -> None:
        for name in ("rospy_listener", "roscpp_listener"):
            listener = self.nodes[name]
            for talker in ("/rospy_talker", "/roscpp_talker", "/guest_talker"):
                listener.wait_for(event="received", publisher=talker, since=listener.mark())


def _node(site: Site, name: str) -> Process:
    client, _, role = name.partition("_")
    match client, role:
        case "guest", "talker":
            return site.guest.talker("rospy", "/chatter", name=name)
        case "rospy" | "roscpp", "talker":
            return site.robot.talker(client, "/chatter", name=name)
        case "rospy" | "roscpp", "listener":
            return site.robot.listener(client, "/chatter", name=name)
        case _:
            return site.robot.service_server("roscpp", "/negate", name=name)


@pytest.fixture(scope="module")
def site(common_lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    lab = common_lab
    host, robot, guest = (
        lab.host("appliance", f"{OWN}/24"),
        lab.host("robot", f"{ROBOT}/24"),
        lab.host("guest", f"{GUEST}/24"),
    )
    inside = lab.host("behind", "10.76.0.2/24")
    interfaces.delete_link(inside.namespace, "eth0")
    behind = guest_behind(lab.host("laptop", "10.77.0.20/24").namespace, inside.namespace, TRANSLATORS[0])
    with (
        Appliance(host, policy=POLICY, settings=SETTINGS, options=("--api", f"{OWN}:8443")) as appliance,
        RosSession(appliance.master_uri, tmp_path_factory.mktemp("ros"), robot) as ros,
    ):
        appliance.rosrv("door", "add", "agent", "--port", "9091", "--from", ROBOT)
        eventually(lambda: not appliance.row("door", "list")["trouble"], "the door serves")
        found = Site(appliance, lab, ros, ros.on(guest), ros.on(behind), {})
        for name in (
            "rospy_talker",
            "roscpp_talker",
            "guest_talker",
            "rospy_listener",
            "roscpp_listener",
            "roscpp_server",
        ):
            found.nodes[name] = _node(found, name)
        found.hears()
        yield found


# --- the state ---


def _rows(site: Site) -> dict[str, list[str]]:
    with contextlib.closing(
        sqlite3.connect(f"file:{site.appliance.state}/control/state.db?mode=ro", uri=True)
    ) as state:
        return {
            table: sorted(str(row) for row in state.execute(f"SELECT {columns} FROM {table}"))  # noqa: S608  ours
            for table, columns in _KEPT.items()
        }


def _connected(site: Site) -> dict[str, list[str]]:
    found = {}
    for name, node in site.nodes.items():
        session = site.guest if name.startswith("guest") else site.robot
        ready = next(event for event in node.events if event.get("event") == "ready")
        uri = call_on(
            session.host, site.appliance.master_uri, "lookupNode", "/test", ready.get("name", f"/{name}")
        )[2]
        rows = call_on(session.host, uri, "getBusInfo", "/test")[2]
        found[name] = sorted(f"{row[4]} {row[2]} {_host(row[1]) if row[2] == 'i' else ''}" for row in rows)
    return found


def _host(uri: str) -> str:
    """Return a publisher's URI without its port: a publisher that starts again has another one."""
    return uri.rpartition(":")[0]


def _held(pid: int) -> Counter[str]:
    held: Counter[str] = Counter()
    with contextlib.suppress(OSError):
        for file in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                held[re.sub(r"\[?\d+\]?|/tmp/\S*/", "", str(file.readlink()))] += 1
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):
                held["thread " + (task / "comm").read_text().strip()] += 1
    return held


def digest(site: Site) -> dict[str, Any]:
    status = site.appliance.status()
    limits = site.appliance.rows("limits")
    groups = site.appliance.row("drive", "status")["groups"]
    rules = site.appliance.host.popen(
        ["nft", "list", "ruleset"], stdout=subprocess.PIPE, text=True
    ).communicate(timeout=20)[0]
    alarms = [*status["troubles"], *status["attention"]]
    graph = call_on(site.robot.host, site.appliance.master_uri, "getSystemState", "/test")[2]
    return {
        "status": {name: status[name] for name in _STATUS},
        "nodes": sorted(
            f"{row['name']} {row['host']} {row['state']}" for row in site.appliance.rows("node", "list")
        ),
        "hosts": sorted(map(str, site.appliance.rows("host", "list"))),
        "groups": [f"{row['group']} {row['holder']} {row['waiting']}" for row in groups],
        "doors": [f"{row['name']} {row['trouble']} {row['connections']}" for row in status["doors"]["doors"]],
        "kept": _rows(site),
        "connected": _connected(site),
        "limits": Counter({row["resource"]: row["used"] for row in limits if "bytes" not in row["resource"]}),
        "alarms": sorted(text for text in alarms if "in the last" not in text),  # else it lasts for minutes
        "rules": re.sub(
            r"counter packets \d+ bytes \d+|expires \S+|timeout \S+|\s*elements = \{[^}]*\}", "", rules
        ),
        "held": {
            f"{row['role']} {row.get('instance', '')}": _held(row["pid"])
            for row in status["processes"]
            if row["pid"]
        },
        "graph": sorted(f"{name} {sorted(nodes)}" for part in graph for name, nodes in part),
    }


# Between calls roscpp keeps the connections of its last ones.
_KEPT_BY_ROSCPP = {"socket:": 6, "connections to RVMaster and nodes": 6}


def differences(before: Any, after: Any, at: str = "") -> Iterator[str]:
    if isinstance(before, Counter) and isinstance(after, Counter):
        yield from (
            f"{at} / {what}: {before[what]} → {number}"
            for what, number in after.items()
            if number - before[what] >= _KEPT_BY_ROSCPP.get(what, 4)  # less is of the moment
        )
    elif isinstance(before, dict) and isinstance(after, dict):
        for key in sorted({*before, *after}):
            yield from differences(before.get(key), after.get(key), f"{at} / {key}")
    elif isinstance(before, list) and isinstance(after, list):
        gone, new = Counter(before) - Counter(after), Counter(after) - Counter(before)
        if new or (gone and "kept" not in at):  # a row of an earlier loss may be forgotten since
            yield f"{at}: gone {dict(gone)}, new {dict(new)}"
    elif before != after:
        yield f"{at}: {before!r:.300} → {after!r:.300}"


# --- the losses ---


def restarts(name: str, number: signal.Signals) -> Callable[[Site], None]:
    return lambda site: site.restart(name, number)


def hangs(name: str) -> Callable[[Site], None]:
    def lose(site: Site) -> None:
        os.kill(site.nodes[name].pid, signal.SIGSTOP)
        threading.Event().wait(2)
        os.kill(site.nodes[name].pid, signal.SIGCONT)

    return lose


def killed(role: str, after: float = 0.0) -> Callable[[Site], None]:
    """Kill a process that has run for some seconds."""

    def lose(site: Site) -> None:
        threading.Event().wait(after)
        pid = site.appliance.kill(role)
        eventually(
            lambda: site.appliance.pids(role) and pid not in site.appliance.pids(role), site.appliance.story
        )

    return lose


def blocked(site: Site) -> None:
    site.appliance.rosrv("host", "block", GUEST)
    site.appliance.rosrv("host", "unblock", GUEST)


def denied(site: Site) -> None:
    site.appliance.reload(POLICY.replace("default = site\n/held", f"default = {ROBOT}\n/held"))
    site.appliance.reload(POLICY)


def viewed(site: Site) -> None:
    def view() -> None:
        with connect(f"ws://{OWN}:9091", open_timeout=20) as client:
            for topic, kind in (("/chatter", "std_msgs/String"), ("/new", "std_msgs/Header")):
                client.send(json.dumps({"op": "subscribe", "topic": topic, "type": kind}))
            client.send(json.dumps({"op": "call_service", "service": "/negate", "args": [True]}))
            while json.loads(client.recv(20))["op"] != "service_response":
                pass
            while json.loads(client.recv(20))["op"] != "publish":
                pass

    site.robot.host.run(view)  # type: ignore[attr-defined]  # a host of the lab


def revoked(site: Site) -> None:
    site.appliance.rosrv("token", "add", "passing", "--role", "viewer")
    site.appliance.rosrv("token", "revoke", "passing")


def driven(site: Site) -> None:
    site.appliance.rosrv("drive", "assign", "base", "--host", GUEST)
    driver = site.guest.talker("rospy", "/cmd", name="driver")
    driver.stop()
    site.appliance.rosrv("drive", "free", "base", check=False)


def _approved(site: Site, calls: int, leave: Callable[[], object]) -> None:
    """Approve as many calls, `leave`, and end the approvals. A refusal would pause the next call for two minutes."""

    def waiting() -> list[Approval] | None:
        found = site.appliance.ask(ApprovalsWanted()).approvals
        return found if len(found) == calls else None

    given = eventually(waiting, lambda: str(site.appliance.ask(ApprovalsWanted())))
    for call in given:
        site.appliance.ask(ApproveCall(call.number))
    leave()
    for call in given:
        site.appliance.ask(RefuseCall(call.number))


def asked(site: Site) -> None:
    """A publisher that waited for its approval ends, and the operator ends the approval."""
    waiting = site.guest.start(
        ["/usr/bin/rostopic", "pub", "-r", "5", "/held/one", "std_msgs/String", "x"], label="held"
    )
    _approved(site, 1, waiting.stop)


def unplugged(site: Site) -> None:
    for state in ("down", "up"):
        site.guest.host.popen(["ip", "link", "set", "eth0", state]).wait(timeout=20)
        threading.Event().wait(2)


def called(site: Site) -> None:
    client = site.guest.service_client("rospy", "/negate", "--persistent", name="caller")
    client.send("true")
    client.wait_for(event="answered")
    client.stop()


def translated(site: Site) -> None:
    """Behind NAT a subscriber hears and is killed, and a publisher is refused."""
    ear = site.behind.listener("rospy", "/chatter", name="ear")
    ear.wait_for(event="received")
    refused = site.behind.run(
        "rostopic", "pub", "-1", "/told", "std_msgs/String", "x", check=False, timeout=20
    )
    assert "--network host" in refused.stderr
    ear.kill()


def half_open(site: Site) -> None:
    """Connections that say nothing, to each port of the appliance, and end."""

    def open_all() -> None:
        clients = []
        for port in (11311, 8443, 9091):
            for _ in range(5):
                clients.append(socket.create_connection((OWN, port), timeout=20))
        threading.Event().wait(0.5)
        for client in clients:
            client.close()

    site.guest.host.run(open_all)  # type: ignore[attr-defined]  # a host of the lab


def hanging(role: str) -> Callable[[Site], None]:
    """A process stops without an end: the supervisor replaces it."""

    def lose(site: Site) -> None:
        pid = eventually(lambda: site.appliance.pids(role), site.appliance.story)[0]
        os.kill(pid, signal.SIGSTOP)
        if role == "relay":
            site.appliance.rosrv("drive", "free", "base", check=False)
        eventually(lambda: not Path(f"/proc/{pid}").exists(), site.appliance.story)
        eventually(lambda: site.appliance.pids(role), site.appliance.story)

    return lose


def handed_over(site: Site) -> None:
    """The relay is lost while a group changes its holder."""
    site.appliance.rosrv("drive", "assign", "base", "--host", GUEST)
    pid = site.appliance.kill("relay")
    site.appliance.rosrv("drive", "assign", "base", "--host", ROBOT, check=False)
    eventually(lambda: pid not in site.appliance.pids("relay"), site.appliance.story)
    site.appliance.rosrv("drive", "free", "base", check=False)


def killed_in_a_change(site: Site) -> None:
    """Control is lost while a policy takes rights away, and another gives them back."""

    def change() -> None:
        with contextlib.suppress(AssertionError):  # control may be lost before it answers
            denied(site)

    changed = threading.Thread(target=change)
    changed.start()
    killed("control")(site)
    changed.join()
    site.appliance.reload(POLICY)


def _calls(site: Site, *calls: tuple[str, ...]) -> None:
    def call() -> None:
        with master_at(site.appliance.master_uri) as master:
            for method, *parameters in calls:
                getattr(master, method)("/filler", *parameters, f"http://{GUEST}:4000/")

    site.guest.host.run(call)  # type: ignore[attr-defined]  # a host of the lab


def names_filled(site: Site) -> None:
    """A guest registers many names, also as a publisher of the robot's topic."""
    topics = ["/chatter", *(f"/filled/{number}" for number in range(200))]
    _calls(site, *(("registerPublisher", topic, "std_msgs/String") for topic in topics))
    _calls(site, *(("unregisterPublisher", topic) for topic in topics))


def approvals_filled(site: Site) -> None:
    topics = [f"/held/{number}" for number in range(40)]
    _calls(site, *(("registerPublisher", topic, "std_msgs/String") for topic in topics))
    _approved(
        site,
        APPROVALS.bounds.host,
        lambda: _calls(site, *(("unregisterPublisher", topic) for topic in topics)),
    )


_ENDS = {"kill": signal.SIGKILL, "end": signal.SIGINT}
LOSSES_OF: dict[str, Callable[[Site], None]] = {
    **{
        f"{name} {how}": restarts(name, number)
        for name in (
            "rospy_listener",
            "roscpp_listener",
            "rospy_talker",
            "roscpp_talker",
            "guest_talker",
            "roscpp_server",
        )
        for how, number in _ENDS.items()
    },
    **{f"{name} hangs": hangs(name) for name in ("rospy_listener", "roscpp_talker")},
    **{f"{role} killed": killed(role) for role in ("relay", "control", "rosmaster", "rosout", "signer")},
    **{  # after short runs these are started later and later
        f"{role} killed": killed(role, STABLE_SECONDS) for role in ("api", "door")
    },
    **{f"{role} hangs": hanging(role) for role in ("relay", "control")},
    "hand-over lost": handed_over,
    "policy change lost": killed_in_a_change,
    "names filled": names_filled,
    "approvals filled": approvals_filled,
    "host blocked": blocked,
    "policy changed": denied,
    "door viewed": viewed,
    "token revoked": revoked,
    "group driven": driven,
    "approval asked": asked,
    "cable unplugged": unplugged,
    "service called": called,
    "nodes behind NAT": translated,
    "connections opened": half_open,
}


@pytest.fixture(scope="module")
def steady(site: Site) -> dict[str, Any]:
    """Return the state before all losses, once it rests: a node that unregistered is forgotten after half a minute."""
    for lose in LOSSES_OF.values():  # what a first use keeps for good, such as the node of a door
        lose(site)
    site.hears()
    found = [digest(site)]

    def rests() -> bool:
        threading.Event().wait(_REST_SECONDS)
        found.append(digest(site))
        return not list(differences(found[-2], found[-1]))

    eventually(rests, lambda: "\n".join(differences(found[-2], found[-1])), seconds=300)
    return found[-1]


@pytest.mark.timeout(1200)
@pytest.mark.parametrize("kind", LOSSES_OF)
def test_nothing_differs_after_losses_and_returns(site: Site, steady: dict[str, Any], kind: str) -> None:
    for _ in range(LOSSES):
        LOSSES_OF[kind](site)
        site.hears()
    found: list[str] = []

    def same() -> bool:
        found[:] = differences(steady, digest(site))
        return not found

    eventually(same, lambda: "\n".join(found), seconds=180)
