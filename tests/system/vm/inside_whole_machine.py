"""The appliance, and the machine of a trusted host, in the virtual machine, whose own network the tests change."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.network import interfaces
from appliance.network.namespaces import Namespace, namespaces
from examples.landshark.lab import INTERFACE, Host, Lab
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.processes import LIMIT
from tests.support.root_host import root_host
from tests.support.tunnel_site import ATTACKER, LONG, MIDDLE, OCU, OWN, POLICY, ROBOT, TunnelSite
from tests.support.tunnels import JoinedHost
from tests.support.wire import connect


@pytest.fixture
def lab() -> Iterator[Lab]:
    with Lab("rosrv-machine") as lab:
        yield lab


def told(*command: str) -> str:
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT, check=False
    )
    return done.stdout


def state_of_the_machine() -> dict[str, object]:
    return {
        "rules": told("nft", "list", "ruleset"),
        "iptables": "ROSRV" in told("iptables-legacy-save") + told("ip6tables-legacy-save"),
        "states": told("ip", "xfrm", "state"),
        "policies": told("ip", "xfrm", "policy"),
        "interfaces": sorted(interfaces.links(Namespace.own())),
        "addresses": sorted(
            address for address in interfaces.addresses(Namespace.own()) if not address.startswith("fe80")
        ),
        "namespaces": [one.name for one in namespaces() if not one.name.startswith("rosrv-machine")],
        "forwarding": Path("/proc/sys/net/ipv4/ip_forward").read_text(),
    }


@pytest.mark.parametrize(
    ("isolation", "backend"),
    [("container", "iptables"), ("netns", "nft")],
    ids=["container", "netns"],
)
def test_the_appliance_on_a_machine(lab: Lab, tmp_path: Path, isolation: str, backend: str) -> None:
    robot, ocu = lab.host("robot", f"{ROBOT}/24"), lab.host("ocu", f"{OCU}/24")
    attacker = lab.host("attacker", f"{ATTACKER}/24")
    config, kit = tmp_path / "appliance.yaml", tmp_path / "kit.tar.gz"
    config.write_text(f"firewall: {{backend: {backend}}}\n")
    options = ("--listen", "0.0.0.0:11311", "--api", "off", "--config", str(config))
    with root_host(lab, f"{MIDDLE}/24") as machine:
        before = state_of_the_machine()
        with Appliance(machine, policy=POLICY, isolation=isolation, options=options) as one:
            one.rosrv("host", "add", "ocu-1", "--appliance", MIDDLE, "--output", str(kit))
            with JoinedHost(ocu, kit, tmp_path / "ocu") as joined:
                joined.wait_until_up()
                with (
                    RosSession(joined.master, tmp_path, joined) as there,
                    RosSession(f"http://{MIDDLE}:11311", tmp_path, robot) as here,
                ):
                    there.talker("rospy", "/orders", name="boss")
                    here.listener("rospy", "/orders", name="arm").wait_for(event="received", timeout=LONG)
                interfaces.add_address(attacker.namespace, INTERFACE, f"{joined.address}/32")
                assert connect(attacker, joined.address, MIDDLE) == "nothing"
                assert connect(attacker, ATTACKER, MIDDLE) == "connected"
                assert connect(ocu, joined.address, OWN) == "connected"
                status = one.status()
            assert status["ipsec"]["esp"] == "kernel"
            assert (status["isolation"], status["firewall"]["backend"]) == (isolation, backend)
            assert status["probe"] == "passed"
            assert one.stop() == 0
        assert state_of_the_machine() == before


def test_a_host_joins_and_leaves_by_its_kit(lab: Lab, tmp_path: Path) -> None:
    with (
        TunnelSite(lab, tmp_path, options=("--api", "off")) as site,
        root_host(lab, "10.88.0.50/24") as machine,
    ):
        kit = site.kit()
        before = state_of_the_machine()
        subprocess.run(["tar", "-xzf", str(kit), "-C", str(tmp_path)], check=True)
        folder = tmp_path / "rosrv-ocu-1"
        joining = subprocess.run(
            [str(folder / "join.sh")], capture_output=True, text=True, timeout=LONG * 2, check=False
        )
        assert joining.returncode == 0, (
            joining.stdout + joining.stderr + told("journalctl", "-u", "strongswan")
        )
        assert "ESP runs in the kernel" in joining.stdout
        setting = next(line for line in joining.stdout.splitlines() if "ROS_MASTER_URI=" in line)
        master = setting.split("ROS_MASTER_URI=")[1].split()[0]
        address = setting.split("ROS_IP=")[1].split()[0]
        node = _Joined(address, machine)
        with (
            RosSession(master, tmp_path, node) as there,
            RosSession(f"http://{MIDDLE}:11311", tmp_path, site.robot) as here,
        ):
            there.talker("rospy", "/orders", name="boss")
            here.listener("rospy", "/orders", name="arm").wait_for(event="received", timeout=LONG)
            ports = listening()
            assert ports
            for port in ports:  # all 28,000 take minutes in an emulated machine
                seen = site.attacker.popen(
                    [ROSRV, "protect", "--check", "10.88.0.50", "--ports", f"{port}-{port}"],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
                assert "closed" in seen.communicate(timeout=LONG)[0], port
        site.is_up()
        leaving = subprocess.run(
            [str(folder / "leave.sh")], capture_output=True, text=True, timeout=LONG, check=False
        )
        assert leaving.returncode == 0, leaving.stderr
        told("systemctl", "stop", "strongswan")
        assert state_of_the_machine() == before


def listening() -> set[int]:
    first = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text(encoding="ascii").split()[0])
    rows = map(str.split, told("ss", "-Hltn").splitlines())
    return {port for row in rows if (port := int(row[3].rpartition(":")[2])) >= first}


class _Joined:
    def __init__(self, address: str, machine: Host) -> None:
        self.address = address
        self.popen = machine.popen
