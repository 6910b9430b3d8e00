"""The sandbox of each process, tested from inside as the role's user, with the settings of the role's row.

The same attempts succeed without a sandbox, so the sandbox causes the refusals.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.channel.channel import Channel
from appliance.channel.messages import Failed, Lifeline, Message, Walled
from appliance.configuration.sections import Sections
from appliance.features.table import FEATURES
from appliance.supervisor.process_slot import ProcessSlot
from appliance.supervisor.role import Facts, Role
from appliance.supervisor.roles import ROLES
from appliance.supervisor.sandbox import landlock
from appliance.supervisor.state_directory import StateDirectory
from appliance.supervisor.users import Account, account_of
from tests.integration.supervisor import trying
from tests.support.appliance import Appliance
from tests.support.requirements import need_root, needs
from tests.support.waiting import eventually

ROOT = Path(trying.__file__).parents[3]
CHILD = "appliance.supervisor.child_entry"
UNIX, NETWORK, ROUTES = (
    ["AF_UNIX"],
    ["AF_UNIX", "AF_INET", "AF_INET6"],
    ["AF_UNIX", "AF_INET", "AF_INET6", "AF_NETLINK"],
)
# Rights that differ by role: socket families, listening, and connecting to the two ports of the test.
MAY = {
    "rosmaster": (ROUTES, False, [True, True]),
    "signer": (UNIX, False, [False, False]),
    "relay": (NETWORK, False, [True, True]),
    "control": (ROUTES, True, [True, True]),
    "rosout": (ROUTES, True, [True, True]),
    "api": (UNIX, False, [False, False]),
    "charon": (ROUTES, False, [False, False]),
    "syslog": (ROUTES, False, [True, False]),
    "fleet": (ROUTES, False, [True, False]),
    "bundles": (ROUTES, False, [True, False]),
    "recorder": (UNIX, False, [False, False]),
}
PROGRAMS = {"rosmaster", "rosout", "charon"}


@pytest.fixture(scope="module")
def place() -> Iterator["Place"]:
    need_root()
    needs(landlock.version() >= landlock.SIGNALS, "a kernel with Landlock 6")
    # pytest's folder is closed to the users of the processes
    with tempfile.TemporaryDirectory(prefix="rosrv-sandbox-") as name:
        directory = Path(name)
        directory.chmod(0o755)
        with Place(directory) as place:
            yield place


class Place:
    def __init__(self, directory: Path) -> None:
        self.roles = {role.name: role for role in ROLES}
        self.state = StateDirectory(directory / "state")
        self.state.prepare(self.roles.values())
        self.state.write_config("{}")
        self.theirs = directory / "theirs"
        self.theirs.mkdir()
        (self.theirs / "file").write_text("of somebody else")
        self.theirs.chmod(0o777)
        (self.theirs / "file").chmod(0o666)
        self.servers = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
        self.ports = [server.getsockname()[1] for server in self.servers]

    def __enter__(self) -> "Place":
        return self

    def __exit__(self, *exc: object) -> None:
        for server in self.servers:
            server.close()
        self.state.close()

    def trial(self, role: Role, pid: int) -> dict[str, Any]:
        part = self.state.path / role.part
        (self.theirs / "new").unlink(missing_ok=True)
        wanted = {
            "ports": self.ports,
            "reads": [
                "/etc/hostname",
                str(self.state.config),
                str(self.theirs / "file"),
                "/var/cache/debconf/templates.dat",
            ],
            "writes": [str(part / "mine"), str(self.theirs / "new"), str(self.theirs / "file"), "/dev/null"],
            "pid": pid,
        }
        (part / "trial").write_text(json.dumps(wanted))
        (part / "trial").chmod(0o644)
        return wanted

    def inside(self, role: Role, entry: str = "main") -> tuple[dict[str, Any], Walled]:
        done, (said, *_more) = self.start(role, f"{trying.__name__}:{entry}")
        assert done.returncode == 0, done.stderr
        assert isinstance(said, Walled)
        return json.loads(done.stderr.splitlines()[-1]), said

    def start(self, role: Role, entry: str) -> tuple[subprocess.CompletedProcess[str], list[Message]]:
        here, there = socket.socketpair()
        files = dict.fromkeys(("ca", "certificate", "key", "receipt_key"), Path("/etc/ssl/certs/none.pem"))
        receivers: dict[str, dict[str, Any]] = {
            "audit.syslog": {"to": f"tcp://127.0.0.1:{self.ports[0]}"},
            "fleet": {"collector": f"https://127.0.0.1:{self.ports[0]}", **files},
        }
        sections = [
            feature.settings(**receivers[feature.settings.place])
            for feature in FEATURES
            if feature.settings is not None and feature.settings.place in receivers
        ]
        facts = Facts(
            self.state.path,
            self.state.config,
            self.ports[0],
            "http://127.0.0.1:1",
            sections=Sections({type(section): section for section in sections}),
        )
        plan = ProcessSlot(role, 0).plan(facts, there.fileno(), None)
        sandbox = replace(plan.sandbox, reads=(*plan.sandbox.reads, str(ROOT)))
        plan = msgspec.structs.replace(plan, sandbox=sandbox, argv=(), entry=entry, secret=None)
        with here, there:
            done = subprocess.run(
                [sys.executable, "-P", "-m", CHILD, role.name, msgspec.json.encode(plan).decode()],
                env={"PYTHONPATH": str(ROOT), "PATH": os.environ["PATH"], "HOME": plan.home},
                pass_fds=(there.fileno(),), stderr=subprocess.PIPE, text=True, cwd="/", check=False, timeout=60,
            )  # fmt: skip
            return done, [said for said, _fds in Channel(here, Lifeline).receive()]

    def outside(self, role: Role, account: Account) -> dict[str, Any]:
        done = subprocess.run(
            [sys.executable, "-P", "-m", trying.__name__],
            user=account.uid, group=account.gid, extra_groups=[], env={"PYTHONPATH": str(ROOT)},
            cwd=self.state.path / role.part, stdout=subprocess.PIPE, text=True, check=True, timeout=60,
        )  # fmt: skip
        found: dict[str, Any] = json.loads(done.stdout)
        return found


@pytest.mark.parametrize("name", sorted(MAY.keys() & {role.name for role in ROLES}))
def test_the_sandbox_denies_forbidden_calls(place: Place, name: str) -> None:
    role = place.roles[name]
    account = account_of(role.user, role.group)
    families, listens, connects = MAY[name]
    with subprocess.Popen(
        ["/bin/sleep", "60"], user=account.uid, group=account.gid, extra_groups=[]
    ) as sleeper:
        try:
            place.trial(role, sleeper.pid)
            found, said = place.inside(role)
            assert sleeper.poll() is None
            outside = place.outside(role, account)
            sleeper.wait(timeout=60)  # the number of the signal
        finally:
            sleeper.kill()
    assert said == Walled("usual" if name in PROGRAMS else "listed", landlock.version(), [])
    assert found["filtered"]
    assert {
        call: outcome for call, outcome in found["calls"].items() if outcome not in ("EPERM", "not there")
    } == {}
    by_the_sandbox = {call for call in found["calls"] if outside["calls"][call] != found["calls"][call]}
    assert by_the_sandbox >= {
        "ptrace",
        "unshare",
        "setns",
        "keyctl",
        "add_key",
        "io_uring_setup",
        "process_vm_readv",
        "kcmp",
    }
    assert found["new namespace"] in ("EPERM", "ENOSYS")
    assert (found["fork"], found["program"]) == (
        ("done", "done")
        if name == "charon"
        else ("done", "EACCES")
        if name in PROGRAMS
        else ("ENOSYS", found["program"])
    )
    assert found["program"] != "done" or name == "charon"
    assert found["write and execute"] in ("EPERM", "ENOSYS")
    assert found["execute later"] == "done"
    assert found["families"] == families
    assert (found["bind"] == "done") is listens
    assert [one == "done" for one in found["connect"]] == connects
    assert [one == "done" for one in found["read"].values()] == [True, True, False, False]
    assert [one == "done" for one in found["write"].values()] == [True, False, False, True]
    # Each program that others made has its own user, so these calls reach no other process.
    free = {"setpriority", "sched_setaffinity", "prlimit64"} if name in PROGRAMS else set()
    assert {call for call, outcome in found["other process"].items() if outcome == "done"} == free
    assert set(outside["other process"].values()) == {"done"}
    for what in ("read", "write"):
        assert set(outside[what].values()) == {"done"}, "allowed to its user without the sandbox"


def test_a_relay_runs_modules_in_its_sandbox(place: Place) -> None:
    found, said = place.inside(place.roles["relay"], "run_modules")
    assert said == Walled("listed", landlock.version(), [])
    assert (found["results"], found["traps"]) == ([7, 7], ["integer division by zero"] * 2)
    assert len(found["executable"]) >= found["before"] + 2
    assert {protection[:3] for protection in found["executable"]} == {"r-x"}
    assert found["threads"] == 1


def test_status_shows_the_sandbox(appliance: Appliance) -> None:
    needs(landlock.version() >= landlock.SIGNALS, "a kernel with Landlock 6")
    rows = appliance.processes()
    rest = {row["role"]: row for row in appliance.rest().get("/v1/status").json["processes"]}
    specification = appliance.directory / "count.rv"
    specification.write_text("count() { int n = 0; event said() /chatter std_msgs/String '{}' { n++; } }\n")
    appliance.rosrv("monitor", "load", str(specification))
    memory = Path(f"/proc/{rows['relay']['pid']}/maps").read_text()
    appliance.rosrv("monitor", "remove", "count")
    abi = landlock.version()
    for name in ("signer", "relay", "control", "api"):
        assert (rows[name]["sandbox"], rows[name]["lacks"]) == (f"listed calls, Landlock {abi}", [])
        assert rest[name]["sandbox"] == rows[name]["sandbox"]
    for name in ("rosmaster", "rosout"):
        assert (rows[name]["sandbox"], rows[name]["lacks"]) == (f"usual calls, Landlock {abi}", [])
    assert rows["supervisor"]["sandbox"] == ""
    assert "_libwasmtime.so" in memory, "the specification is compiled to a module"
    assert not [line for line in memory.splitlines() if "w" in line.split()[1] and "x" in line.split()[1]]


def test_status_shows_the_relays_congestion_control(appliance: Appliance) -> None:
    def congestion() -> str:
        said: str = appliance.processes()["relay"]["congestion"]
        return said

    allowed = Path("/proc/sys/net/ipv4/tcp_allowed_congestion_control").read_text().split()
    assert eventually(congestion, appliance.story) == ("cubic" if "cubic" in allowed else "reno")


def test_an_incomplete_installation_names_the_remedy(place: Place) -> None:
    done, reports = place.start(place.roles["relay"], "appliance.relay.transport.absent:main")
    assert done.returncode == 1
    assert isinstance(reports[-1], Failed)
    assert "No module named 'appliance.relay.transport.absent'; " in reports[-1].reason
    assert "make setup" in reports[-1].reason
