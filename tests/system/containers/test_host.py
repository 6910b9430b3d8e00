import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.network.scan import scan
from tests.support.docker import Compose, MachineInside, project_beside
from tests.support.nodes import RosSession, need_ros
from tests.support.waiting import eventually
from tests.system.containers.conftest import Site

pytestmark = pytest.mark.timeout(1500)  # for the first test: the images are built

APPLIANCE, MACHINE = "172.29.76.2", MachineInside.address
LOCAL_PORTS = range(32768, 61000)


@pytest.fixture
def beside(site: Site, tmp_path: Path) -> Iterator[Compose]:
    compose = site.engine.compose(project_beside(tmp_path), "host")
    try:
        compose("up", "--detach", "--no-build")
        compose.wait_healthy()
        yield compose
    finally:
        compose("down", "--volumes", "--timeout", "5")


def test_nodes_of_the_machine_work_and_its_ports_are_closed(
    site: Site, beside: Compose, tmp_path: Path
) -> None:
    need_ros()
    rules = beside.exec("appliance", "rosrv", "protect", "--appliance", APPLIANCE).stdout

    def nft(*arguments: str, text: str = "") -> None:
        subprocess.run(["nft", *arguments], input=text, text=True, check=True, capture_output=True)

    with RosSession(f"http://{APPLIANCE}:11311", tmp_path, MachineInside(site.machine)) as ros:
        listener = ros.listener("rospy", "/chatter", name="listener")
        ros.talker("roscpp", "/chatter", name="talker")
        listener.wait_for(event="received")
        registered = eventually(
            lambda: beside.audit("--event", "registered", caller_id="/talker"), beside.story
        )
        assert {record["host"] for record in registered} == {MACHINE}

        def open_ports() -> tuple[int, ...]:
            return site.laptop.run(lambda: scan("10.79.0.1", LOCAL_PORTS, seconds=2.0)).open

        assert open_ports(), "without protection a scanner finds the nodes"
        site.machine.run(lambda: nft("-f", "-", text=rules))
        try:
            assert open_ports() == ()
            second = ros.listener("roscpp", "/chatter", name="second")
            second.wait_for(event="received")
        finally:
            site.machine.run(lambda: nft("delete", "table", "inet", "rosrv_protect"))


def test_without_the_machines_own_rule_every_host_is_denied(site: Site, beside: Compose) -> None:
    assert beside.status()["policy"]["file"] == "/etc/rosrv/policies/default.ini"
    said = beside.exec(
        "appliance", "rosrv", "policy", "explain", "policies/default.ini", "--robot", MACHINE,
        "--host", "172.29.78.20", "--node", "/ocu", "--publish", "/cmd_vel", check=False,
    ).stdout  # fmt: skip
    assert "deny" in said.lower() or "not among" in said
