"""A robot and a laptop of Noetic's generation beside the appliance in its container: docs/install.md.

Debian's archive does not have Ubuntu. Debian 11 is as old: ROS 1.15, Python 3.9, OpenSSL 1.1.1, nftables 0.9,
strongSwan 5.9.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Lab
from tests.support.debian_base import make_base
from tests.support.docker import APPLIANCE, Engine, MachineInside, builder, project
from tests.support.nodes import RosSession
from tests.support.script_host import ScriptHost
from tests.support.tunnel_site import MASTER, MIDDLE, OWN, POLICY, TunnelSite
from tests.support.tunnels import need_strongswan
from tests.support.waiting import eventually

pytestmark = pytest.mark.timeout(2400)  # the system is fetched, and the image is built
SUITE = "bullseye"
PACKAGES = (
    # for a robot: unmodified rospy and roscpp nodes, and nftables for `rosrv protect`
    *("python3-rospy", "python3-rostopic", "python3-std-msgs", "topic-tools"),
    # for a kit
    *("charon-systemd", "strongswan-swanctl", "libcharon-extra-plugins", "libstrongswan-standard-plugins"),
    *("nftables", "iproute2", "iputils-ping", "openssl", "curl", "procps"),
)
API = 8443
CONFIG = f"api: 0.0.0.0:{API}\napi_networks: [10.88.0.0/24]\napi_names: [{MIDDLE}]\n"
TALKER = ("rostopic", "pub", "--rate=10", "/chatter", "std_msgs/String", "data: hello")


@pytest.fixture
def system(tmp_path: Path) -> Path:
    return make_base(tmp_path / "system", PACKAGES, suite=SUITE)


def test_a_robot_beside_the_container(system: Path, tmp_path: Path) -> None:
    with builder() as engine:
        engine.build("appliance", APPLIANCE)
    (tmp_path / "project").mkdir()
    with Lab("rosrv-noetic") as lab:
        machine = lab.host("machine", "10.79.0.1/24")
        with Engine(machine) as engine, ScriptHost(machine, tmp_path / "robot", root=system) as robot:
            robot.address = MachineInside.address
            assert " 3.9." in robot.run("python3", "--version").stdout
            files = ("compose.yaml", "compose.host.yaml")
            compose = engine.compose(project(tmp_path / "project"), "noetic", *files)
            try:
                compose("up", "--detach", "--no-build")
                compose.wait_healthy()
                rules = compose.exec("appliance", "rosrv", "protect", "--appliance", "172.29.76.2").stdout
                robot.run("sh", "-c", 'printf %s "$1" | nft -f -', "sh", rules)
                with RosSession("http://172.29.76.2:11311", tmp_path, robot) as ros:
                    ros.start(TALKER)
                    ros.start(["/usr/lib/topic_tools/relay", "/chatter", "/heard"])
                    assert "hello" in ros.run("rostopic", "echo", "-n", "1", "/heard", timeout=60).stdout
                hosts = {(one["category"], one["host"]) for one in compose.audit("--event", "registered")}
                assert ("publication", robot.address) in hosts
            finally:
                compose("down", "--volumes", "--timeout", "5")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[TunnelSite]:
    need_strongswan()
    (tmp_path / "appliance.yaml").write_text(CONFIG)
    with Lab("rosrv-noetic") as lab:
        policy = POLICY.replace("host:ocu-1", "host:laptop")
        options = ("--config", str(tmp_path / "appliance.yaml"))
        with TunnelSite(lab, tmp_path, policy=policy, options=options) as one:
            yield one


LOST = (
    "add table inet lost; add chain inet lost pings { type filter hook output priority 0; };"
    " add rule inet lost pings meta l4proto icmp drop"
)


def lose_pings(site: TunnelSite, laptop: ScriptHost) -> None:
    count = "grep -c 'CHILD_SA ros{[0-9]*} established' /run/rosrv/charon.log"

    def whole() -> bool:
        return bool(laptop.run("swanctl", "--list-sas").stdout.count("INSTALLED") == 1)

    eventually(whole, laptop.log)
    before = int(laptop.run("sh", "-c", count).stdout)
    mark = site.mark
    laptop.run("nft", LOST)
    site.recorded(mark, event="tunnel down")
    laptop.run("nft", "delete", "table", "inet", "lost")
    site.recorded(mark, event="tunnel up")  # it may come before the rule is gone
    eventually(whole, laptop.log)
    assert int(laptop.run("sh", "-c", count).stdout) == before + 1, laptop.log()


def test_a_laptop_joins_renews_and_leaves_without_python(
    site: TunnelSite, system: Path, tmp_path: Path
) -> None:
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    pythons = [path for path in (system / "usr/bin").iterdir() if path.name.startswith("python3")]
    for path in pythons:
        path.rename(hidden / path.name)
    script = system / "root/join.sh"
    added = site.appliance.rosrv(
        "host", "add", "laptop", "--appliance", MIDDLE, "--token", "--output", str(script), "--json"
    )
    with ScriptHost(site.ocu, tmp_path / "laptop", root=system) as laptop:
        assert laptop.run("python3", "--version", check=False).returncode == 127
        assert "OpenSSL 1.1.1" in laptop.run("openssl", "version").stdout
        mark = site.mark
        joined = laptop.run("sh", "/root/join.sh", json.loads(added.stdout)["token"])
        site.recorded(mark, event="tunnel up")
        mark = site.mark
        assert "in force" in laptop.run("/etc/rosrv/renew.sh", "--now").stdout
        site.recorded(mark, event="host renewed")
        site.recorded(mark, event="tunnel up")
        lose_pings(site, laptop)
        for path in pythons:
            (hidden / path.name).rename(path)
        laptop.address = re.findall(r"ROS_IP=(\S+)", joined.stdout)[0]
        with (
            RosSession(MASTER, tmp_path, site.robot) as on_robot,
            RosSession(f"http://{OWN}:11311", tmp_path, laptop) as on_laptop,
        ):
            on_laptop.start(TALKER)
            on_robot.listener("rospy", "/chatter", name="arm").wait_for(event="received")
        mark = site.mark
        laptop.run("/etc/rosrv/leave.sh")
        site.recorded(mark, event="tunnel down")
        assert laptop.run("nft", "list", "tables").stdout == ""
