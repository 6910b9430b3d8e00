"""The boot hold, in namespaces: other machines wait, the machine itself and established connections do not."""

import contextlib
import json
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.network.boot_hold import TABLE, BootHold, HeldPorts, hold_rules
from appliance.network.firewall.backend import Backend
from appliance.network.firewall.firewall_rules import Chain, PortRange
from appliance.network.firewall.iptables import IptablesBackend
from appliance.network.firewall.nft import NftBackend
from appliance.network.isolation import Isolation, IsolationSettings
from examples.landshark.lab import Host, Lab
from tests.support.waiting import eventually

MASTER, OTHER, NODE = 11311, 8080, 40_000
HELD = HeldPorts(MASTER, 32_768, 60_999)


@pytest.fixture
def robot(lab: Lab) -> Host:
    return lab.host("robot", "10.77.0.2/24", "fd77::2/64")


@pytest.fixture
def laptop(lab: Lab) -> Host:
    return lab.host("laptop", "10.77.0.30/24", "fd77::30/64")


@contextlib.contextmanager
def listening(host: Host, *ports: int) -> Iterator[None]:
    with contextlib.ExitStack() as servers, host.entered():
        for port in ports:
            server = socket.create_server(("::", port), family=socket.AF_INET6, dualstack_ipv6=True)
            servers.enter_context(server)
        yield


def connects(host: Host, address: str, port: int) -> bool:
    def attempt() -> bool:
        try:
            socket.create_connection((address, port), timeout=0.7).close()
        except TimeoutError:
            return False
        return True

    return host.run(attempt)


@pytest.mark.parametrize("back_end", ["nft", "iptables"])
def test_only_new_connections_of_other_machines_to_ros_ports_wait(
    robot: Host, laptop: Host, back_end: str
) -> None:
    namespace = robot.namespace
    backend: Backend = (
        NftBackend(namespace, TABLE) if back_end == "nft" else IptablesBackend(namespace, (Chain.HOLD,))
    )
    with listening(robot, MASTER, OTHER, NODE):
        with laptop.entered():
            before = socket.create_connection((robot.address, MASTER), timeout=5)
        with before:
            backend.install(hold_rules(HELD, 0))
            NftBackend(namespace).remove()  # the appliance's own rules come and go beside it
            IptablesBackend(namespace).remove()
            before.sendall(b"still there")
            for address in (robot.address, robot.address6):
                assert not connects(laptop, address, MASTER)
                assert not connects(laptop, address, NODE)
                assert connects(laptop, address, OTHER)
                assert connects(robot, address, MASTER)
                assert connects(robot, address, NODE)
            assert connects(robot, "127.0.0.1", MASTER)
        backend.remove()
        assert connects(laptop, robot.address, MASTER)


def test_the_robots_own_programs_wait_for_their_seconds_only(
    robot: Host, laptop: Host, tmp_path: Path
) -> None:
    with listening(robot, MASTER, NODE):
        hold = service(robot, tmp_path, HeldPorts(MASTER, 32_768, 60_999, own_seconds=2))
        hold.put()
        assert not connects(robot, "127.0.0.1", MASTER)
        assert connects(robot, "127.0.0.1", NODE)
        eventually(lambda: connects(robot, "127.0.0.1", MASTER), "the robot's own programs still wait")
        hold.put()  # as a start after a crash does, which does not begin the seconds again
        assert connects(robot, "127.0.0.1", MASTER)
        assert not connects(laptop, robot.address, MASTER)
        assert hold.lift()
        assert connects(laptop, robot.address, MASTER)
        hold.put()
        assert not connects(robot, "127.0.0.1", MASTER)
        assert not hold.lift()


def service(robot: Host, tmp_path: Path, held: HeldPorts) -> BootHold:
    """Return the hold of an active unit that was armed."""
    (tmp_path / "run").mkdir()
    hold = BootHold(robot.namespace, unit_runs=tmp_path / "run", state=tmp_path)
    hold.arm(held)
    return hold


def test_nothing_is_held_before_a_start_that_served_nor_without_the_unit(
    robot: Host, laptop: Host, tmp_path: Path
) -> None:
    hold = BootHold(robot.namespace, unit_runs=tmp_path / "run", state=tmp_path)
    with listening(robot, MASTER):
        hold.arm(HELD)
        assert not (tmp_path / "armed.json").exists()
        (tmp_path / "armed.json").write_text(json.dumps({"master": MASTER, "first": 32_768, "last": 60_999}))
        hold.put()
        assert connects(laptop, robot.address, MASTER)
        (tmp_path / "run").mkdir()
        hold.put()
        assert not connects(laptop, robot.address, MASTER)
        hold.lift()
        hold.arm(None)
        hold.put()
        assert connects(laptop, robot.address, MASTER)


def test_the_appliance_reaches_nodes_and_is_reached_through_its_link(
    robot: Host, laptop: Host, tmp_path: Path
) -> None:
    isolation = Isolation(
        robot.namespace,
        IsolationSettings(ports=(PortRange.one(OTHER),), master=MASTER, name="rhold", directory=tmp_path),
    )
    isolation.up()
    try:
        service(robot, tmp_path, HeldPorts(MASTER, 32_768, 60_999, isolation.settings.link)).put()
        inside = isolation.namespace
        with listening(robot, NODE):
            inside.run(lambda: socket.create_connection((robot.address, NODE), timeout=5).close())
            assert not connects(laptop, robot.address, NODE)
    finally:
        isolation.down()
