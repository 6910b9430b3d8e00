"""The Debian package on a clean Debian with systemd, in a virtual machine: install, serve, reboot, upgrade, remove."""

import filecmp
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance import __version__
from distribution.deb import LIBRARY, VERSION
from distribution.environment import ARCHITECTURES
from distribution.extension import IN_PLACE, build
from tests.package.conftest import SLOW_SECONDS, build_later, clean_machine, elsewhere
from tests.support.machine import Done, Machine
from tests.support.machine_disk import ROOT

# Packages are built, and a machine boots twice, emulated, perhaps on a busy processor.
pytestmark = pytest.mark.timeout(5400)
EVERYWHERE = {"ROS_MASTER_URI": "http://localhost:11311"}
VISITOR = """\
ip netns add visitor
ip link add site type veth peer name site netns visitor
ip address add 192.168.1.5/24 dev site
ip link set site up
ip -n visitor address add 192.168.1.66/24 dev site
ip -n visitor link set site up
"""


@pytest.fixture
def newer(package: Path, tmp_path: Path) -> Path:
    tree = tmp_path / "newer"
    subprocess.run(["dpkg-deb", "--raw-extract", str(package), str(tree)], check=True)
    control = tree / "DEBIAN/control"
    control.write_text(control.read_text().replace(f"Version: {VERSION}", "Version: 999.0.0"))
    made = tmp_path / "rosrv_999.0.0_amd64.deb"
    # compressed as the package itself: xz takes minutes, in which the machine cannot use the processor
    build = ["dpkg-deb", "--root-owner-group", "-Zgzip", "-z1", "--build", str(tree), str(made)]
    subprocess.run(build, check=True, capture_output=True)
    return made


@pytest.fixture
def machine(package: Path, newer: Path, tmp_path: Path) -> Iterator[Machine]:
    machine = clean_machine(tmp_path, package, {"old.deb": package, "new.deb": newer})
    try:
        yield machine
    finally:
        machine.stop()


def state_of(machine: Machine) -> dict[str, str]:
    looks = {
        "rules": ("nft", "list", "ruleset"),
        "legacy rules": ("iptables-legacy-save",),
        "namespaces": ("ip", "netns", "list"),
        "interfaces": ("ip", "-brief", "link"),
        "forwarding": ("cat", "/proc/sys/net/ipv4/ip_forward"),
        "users at work": ("sh", "-c", "ps -eo user:20= | sort -u | grep -E '^(rosrv|rosmaster)'"),
        "units": ("systemctl", "list-unit-files", "--no-legend", "rosrv*"),
    }
    return {name: machine.run(*command, check=False).output for name, command in looks.items()}


def ros(machine: Machine, *command: str) -> Done:
    return machine.run(
        "env", *(f"{key}={value}" for key, value in EVERYWHERE.items()), *command, seconds=SLOW_SECONDS
    )


def denies_a_visitor(machine: Machine) -> None:
    machine.run("sh", "-euc", VISITOR)
    there = ("env", "ROS_MASTER_URI=http://192.168.1.5:11311", "ROS_IP=192.168.1.66", "rosnode", "list")
    denied = machine.run("ip", "netns", "exec", "visitor", *there, seconds=SLOW_SECONDS, check=False)
    assert "no rule of the policy names 192.168.1.66" in denied.output
    assert "DENY decision 192.168.1.66" in machine.run("rosrv", "audit", "search", "--deny").output
    machine.run("ip", "netns", "delete", "visitor")


def serves(machine: Machine) -> dict[str, object]:
    machine.run("systemctl", "start", "rosrv", seconds=SLOW_SECONDS)  # waits for a start in progress
    status: dict[str, object] = json.loads(machine.run("rosrv", "status", "--json", check=False).output)
    return status


def test_the_life_of_the_package(machine: Machine) -> None:
    machine.start()
    before = state_of(machine)
    machine.run("dpkg", "--install", "old.deb", seconds=SLOW_SECONDS)
    assert serves(machine)["version"] == __version__
    assert machine.run("rosrv", "policy", "check", "/etc/rosrv/policies/default.ini").status == 0
    assert "/etc/rosrv/policies/default.ini" in machine.run("rosrv", "config", "show").output
    assert (
        machine.run("test", "-f", "/usr/lib/rosrv/share/rosrv/examples/landshark/nodes/base.py").status == 0
    )
    processes = machine.run("ps", "-eo", "user:20,args").output
    for user in ("rosrv-relay", "rosrv-api", "rosrv-signer", "rosmaster"):
        assert f"{user} " in processes, processes

    machine.run("systemd-run", "--unit=talker", "--setenv=ROS_MASTER_URI=http://localhost:11311",
                "rostopic", "pub", "--rate=5", "/chatter", "std_msgs/String", "data: hello")  # fmt: skip
    assert "hello" in ros(machine, "rostopic", "echo", "-n", "1", "/chatter").output

    denies_a_visitor(machine)

    main = machine.run("systemctl", "show", "--property=MainPID", "--value", "rosrv").output.strip()
    machine.run("systemctl", "kill", "--kill-whom=main", "--signal=KILL", "rosrv")
    machine.run(
        "tail", f"--pid={main}", "--follow", "/dev/null"
    )  # it exists until systemd has noticed its end
    serves(machine)
    assert "hello" in ros(machine, "rostopic", "echo", "-n", "1", "/chatter").output, (
        "the talker was not restarted"
    )

    machine.run("sh", "-c", "echo '# a line of mine' >> /etc/rosrv/policies/default.ini")
    machine.run("systemctl", "reload", "rosrv")
    machine.run("dpkg", "--install", "new.deb", seconds=SLOW_SECONDS)
    serves(machine)
    assert machine.run("dpkg-query", "--show", "--showformat=${Version}", "rosrv").output == "999.0.0"
    assert "a line of mine" in machine.run("tail", "-1", "/etc/rosrv/policies/default.ini").output
    assert "hello" in ros(machine, "rostopic", "echo", "-n", "1", "/chatter").output, (
        "the upgrade ended the talker"
    )
    assert machine.run("rosrv", "audit", "verify").status == 0

    assert machine.stop(), machine.story()
    machine.start()
    serves(machine)
    denies_a_visitor(machine)
    machine.run("rosrv", "audit", "verify")

    machine.run("systemctl", "kill", "--kill-whom=main", "--signal=KILL", "rosrv")
    machine.run("dpkg", "--remove", "rosrv", seconds=SLOW_SECONDS)
    after = state_of(machine)
    assert {name: text for name, text in after.items() if text != before[name]} == {}
    machine.run("dpkg", "--purge", "rosrv", seconds=SLOW_SECONDS)
    looked = ("/etc", "/var", "/usr", "/lib", "/run", "-xdev", "-name", "*rosrv*")
    others = ("/var/lib/dpkg/*", "/var/log/*", "*rosrv-agent*", "*rosrv.agent*")
    left = machine.run("find", *looked, *(word for path in others for word in ("-not", "-path", path))).output
    assert left == "", left


def test_it_contains_the_compiled_module(package: Path, tmp_path: Path) -> None:
    subprocess.run(["dpkg-deb", "--extract", str(package), str(tmp_path)], check=True)
    module = IN_PLACE.relative_to(ROOT)
    assert [*tmp_path.rglob("pump*.so")] == [tmp_path / LIBRARY / "common" / module]
    assert (tmp_path / LIBRARY / "common" / module).read_bytes() == build(
        ARCHITECTURES["amd64"].triplet
    ).read_bytes()


def test_lintian_finds_no_error(package: Path) -> None:
    done = subprocess.run(
        ["lintian", "--fail-on", "none", str(package)], capture_output=True, text=True, check=False
    )
    assert [line for line in done.stdout.splitlines() if line.startswith("E:")] == []


def test_two_builds_are_the_same(package: Path, tmp_path: Path) -> None:
    folder = elsewhere(tmp_path / "elsewhere")
    (folder / ".venv").symlink_to(ROOT / ".venv")
    second = build_later("distribution.deb", "amd64", folder=folder)
    assert filecmp.cmp(package, second, shallow=False)
