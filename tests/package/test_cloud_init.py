"""The example of docs/install.md. Its web server and its vehicle are in one machine, which has no network card."""

import hashlib
import json
from pathlib import Path

import pytest

from tests.package.conftest import SLOW_SECONDS, clean_machine
from tests.support.machine import Machine
from tests.support.machine_disk import ROOT

pytestmark = pytest.mark.timeout(5400)  # a machine boots three times, with every instruction emulated
EXAMPLE = ROOT / "examples/cloud-init/user-data.yaml"
SEED = "/var/lib/cloud/seed/nocloud"
VEHICLE = ("ip", "netns", "exec", "vehicle", "env", "ROS_MASTER_URI=http://192.168.1.5:11311",
           "ROS_IP=192.168.1.10", "rostopic")  # fmt: skip
NETWORK = """\
[Service]
ExecStartPre=ip netns add vehicle
ExecStartPre=ip link add site address 02:00:00:00:00:05 type veth peer name site netns vehicle
ExecStartPre=ip address add 192.168.1.5/24 dev site
ExecStartPre=ip link set site up
ExecStartPre=ip -n vehicle address add 192.168.1.10/24 dev site
ExecStartPre=ip -n vehicle link set site up
ExecStart=python3 -m http.server --bind 192.168.1.5 --directory /srv 80
ExecStartPost=curl --silent --retry 1000 --retry-delay 1 --retry-connrefused --output /dev/null http://192.168.1.5/

[Install]
WantedBy=multi-user.target
"""
# The machine already has its packages, as it has no network; no locale except C was generated.
OFFLINE = "apt: {preserve_sources_list: true}\nnetwork: {config: disabled}\nlocale: C.UTF-8\n"


def write(machine: Machine, path: str, text: str) -> None:
    machine.run("sh", "-euc", 'mkdir -p "$(dirname "$1")"; printf %s "$2" > "$1"', "sh", path, text)


def boot(machine: Machine, user_data: str, instance: str) -> str:
    write(machine, f"{SEED}/meta-data", f"instance-id: {instance}\n")
    write(machine, f"{SEED}/user-data", user_data)
    assert machine.stop(), machine.story()
    machine.start()
    said = machine.run("cloud-init", "status", "--wait", "--long", seconds=SLOW_SECONDS, check=False)
    return said.output + machine.run("tail", "-n", "60", "/var/log/cloud-init-output.log").output


def test_the_first_boot_makes_an_appliance(package: Path, tmp_path: Path) -> None:
    machine = clean_machine(
        tmp_path, package, {package.name: package}, more=("cloud-init", "chrony"), name="cloud"
    )
    try:
        machine.start()
        machine.run("mv", package.name, "/srv/rosrv.deb")
        write(machine, "/etc/systemd/system/network-of-the-robot.service", NETWORK)
        machine.run("systemctl", "enable", "network-of-the-robot")
        machine.run("sh", "-c", ": > /etc/apt/sources.list; rm -f /etc/apt/sources.list.d/*")
        write(machine, "/etc/cloud/cloud.cfg.d/99-offline.cfg", OFFLINE)

        said = boot(machine, EXAMPLE.read_text(), "as-shipped")
        assert "/var/cache/rosrv.deb: FAILED" in said, said
        assert "status: error" in said, said
        assert machine.run("dpkg-query", "--show", "rosrv", check=False).status == 1

        digest = hashlib.sha256(package.read_bytes()).hexdigest()
        said = boot(machine, EXAMPLE.read_text().replace("0" * 64, digest), "filled-in")
        assert "status: done" in said, said
        status = json.loads(machine.run("rosrv", "status", "--json", check=False).output)
        assert status["policy"]["file"] == "/etc/rosrv/policies/robot.ini"
        talker = ("pub", "--rate=5", "/chatter", "std_msgs/String", "data: hello")
        machine.run("systemd-run", "--unit=talker", *VEHICLE, *talker)
        assert "hello" in machine.run(*VEHICLE, "echo", "-n", "1", "/chatter", seconds=SLOW_SECONDS).output
    finally:
        machine.stop()
