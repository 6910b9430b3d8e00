import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from appliance.channel import admin
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.membership import PORT
from appliance.features.standby.pairing import PAUSED
from appliance.features.standby.witness.protocol import EXPIRY
from examples.landshark.lab import Host
from tests.support.appliance import Appliance
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import ADDRESSES, FIXED, MASTER_PORT, OCU, ROBOT, StandbySite
from tests.support.rest import Answer, Rest
from tests.support.waiting import allowed, eventually

REST = "https://127.0.0.1:8443"
_SOURCE_PORT = 40_000
_TRACKED_SECONDS = 10.0  # that the kernel's connection tracker knows a connection after its reset
_MOVES = 30  # registrations and calls that come and go at any time
ROLES = ("control", "relay", "rosmaster", "signer", "api", "lease")


def orders(site: StandbySite, name: str) -> list[Any]:
    """Return the policies, specifications and tokens, without expiries of tokens: a takeover changes them."""
    one = site.appliances[name]
    monitors = one.ask(admin.MonitorsWanted(True))
    return [
        one.ask(admin.PolicyRevisions()),
        [found.name for found in monitors.monitors],
        [(token.id, token.name, token.role, token.revoked) for token in one.ask(admin.TokenList()).tokens],
    ]


@pytest.fixture(autouse=True)
def nothing_is_lost(site: StandbySite, robot: StandbyRobot) -> Iterator[None]:
    site.until_both_in_sync()
    before = eventually(lambda: orders(site, site.holder()), site.story)
    yield
    site.until_both_in_sync()
    robot.lost_nothing()
    eventually(lambda: robot.admitted() == {ADDRESSES[site.holder()]}, site.story)
    assert eventually(lambda: orders(site, site.holder()), site.story) == before


def test_a_power_cut_of_the_active_appliance(site: StandbySite, robot: StandbyRobot) -> None:
    active, passive = site.pair()
    before = used(site.appliances[active])
    site.cut(active)
    site.until_taken_over(passive)
    robot.lost_nothing()
    robot.serves_newcomers()
    eventually(
        lambda: max((used(site.appliances[passive]) - before).values(), default=0) <= _MOVES, site.story
    )
    site.restore(active)
    site.until_both_in_sync()
    assert site.holder() == passive


def used(appliance: Appliance) -> Counter[str]:
    """Return how much of each quota is in use, but for bytes."""
    return Counter(
        {row["resource"]: row["used"] for row in appliance.rows("limits") if "bytes" not in row["resource"]}
    )


def test_a_port_of_an_earlier_connection_can_be_used_again(site: StandbySite, robot: StandbyRobot) -> None:
    """The connection tracker would lead the new connection to the earlier appliance, which the robot shuts out."""

    def connect() -> socket.socket:
        return socket.create_connection((FIXED, MASTER_PORT), EXPIRY, ("", _SOURCE_PORT))

    active, passive = site.pair()
    with site.robot.run(connect) as before:
        site.cut(active)
        site.until_taken_over(passive)
        before.settimeout(10 * EXPIRY)
        with pytest.raises(ConnectionResetError):
            before.recv(1)
    eventually(lambda: _answers(site, connect), site.story, _TRACKED_SECONDS / 2)
    site.restore(active)


def _answers(site: StandbySite, connect: Callable[[], socket.socket]) -> bool:
    with contextlib.suppress(ConnectionRefusedError), site.robot.run(connect):
        return True
    return False


def test_the_death_of_one_process(site: StandbySite, robot: StandbyRobot) -> None:
    for role in ROLES:
        active, epoch = site.pair()[0], site.lease.read().epoch
        for pid in site.pids(active, role):
            os.kill(pid, signal.SIGKILL)
        eventually(lambda name=active, title=role: site.pids(name, title), site.story)  # type: ignore[misc]  # mypy infers no type for a lambda's default
        if role == "lease":  # the appliance stays active until its time is over, then one of the two claims
            eventually(lambda before=epoch: site.lease.read().epoch > before, site.story)  # type: ignore[misc]  # mypy infers no type for a lambda's default
        robot.lost_nothing()
        site.until_both_in_sync()
        assert role == "lease" or site.holder() == active, role


def test_a_paused_appliance_answers_nothing_when_it_wakes_up(site: StandbySite, robot: StandbyRobot) -> None:
    active, passive = site.pair()
    site.signal(active, signal.SIGSTOP)
    requests = [request(site, active, method) for method in ("getParam", "setParam")]
    try:
        site.until_taken_over(passive)
        robot.works()
        for pid in site.pids(active, "control"):  # before the supervisor can end it
            os.kill(pid, signal.SIGCONT)
        assert not select.select(requests, [], [], EXPIRY)[0]
    finally:
        site.signal(active, signal.SIGCONT)
    assert [answer_to(one) for one in requests] == [b"", b""]
    site.until_both_in_sync()
    assert site.holder() == passive
    assert site.appliances[active].ask(standby_requests.StandbyWanted()).role == "standby"


def request(site: StandbySite, name: str, method: str) -> socket.socket:
    values = "".join(
        f"<param><value>{text}</value></param>"
        for text in ("/late", "/large", "late")[: 3 if method == "setParam" else 2]
    )
    body = f"<methodCall><methodName>{method}</methodName><params>{values}</params></methodCall>".encode()
    host = site.lab.hosts.get("ocu") or site.lab.host("ocu", f"{OCU}/24")
    sock = host.run(lambda: socket.create_connection((ADDRESSES[name], MASTER_PORT), 30))
    sock.sendall(
        b"POST /RPC2 HTTP/1.1\r\nHost: x\r\nContent-Type: text/xml\r\n"
        + b"Content-Length: %d\r\n\r\n" % len(body)
        + body
    )
    return sock


def answer_to(sock: socket.socket) -> bytes:
    with sock:
        try:
            return sock.recv(4096)
        except ConnectionError:
            return b""


def test_a_cut_between_the_appliances(site: StandbySite, robot: StandbyRobot) -> None:
    active, passive = site.pair()
    with site.without_link((ADDRESSES["a"], ADDRESSES["b"])):
        eventually(lambda: site.in_sync() == {active}, site.story)
        robot.lost_nothing()
    site.until_both_in_sync()
    assert site.pair() == (active, passive)


def test_a_lapse_of_the_lease(site: StandbySite, robot: StandbyRobot) -> None:
    """Nothing serves until the lease is renewed; then the same processes continue in the same epoch.

    Without the standby no other appliance can claim. During the pause, operators learn the reason within seconds,
    over the socket, REST and the health check of a container.
    """
    active, passive = site.pair()
    rest = rest_of(site.appliances[active], site.appliances["a"].token)
    site.cut(passive)
    eventually(lambda: site.in_sync() == {active}, site.story)
    epoch, before = site.lease.read().epoch, site.pids(active)
    serving = [pid for role in ("control", "relay", "rosmaster") for pid in site.pids(active, role)]
    (lease,) = site.pids(active, "lease")
    os.kill(lease, signal.SIGSTOP)
    eventually(lambda: all(stopped(pid) for pid in serving), site.story)
    learn_of_the_pause(site.appliances[active], rest)
    os.kill(lease, signal.SIGCONT)
    robot.lost_nothing()
    assert (site.lease.read().epoch, site.pids(active)) == (epoch, before)
    site.restore(passive)
    site.until_both_in_sync()


def rest_of(appliance: Appliance, token: str) -> Callable[[str], Answer]:
    assert isinstance(appliance.host, Host)
    host = appliance.host
    rest = Rest(REST, token, appliance.state / "api" / "certificate.pem")

    def get(path: str) -> Answer:
        return host.run(partial(rest.get, path))

    eventually(lambda: get("/v1/status").status == 200, appliance.story)
    return get


def learn_of_the_pause(appliance: Appliance, get: Callable[[str], Answer]) -> None:
    began = time.monotonic()
    for verb in (("status",), ("standby", "status"), ("policy", "show")):
        done = appliance.rosrv(*verb, check=False)
        assert (done.returncode, PAUSED in done.stderr) == (1, True), done
    health = subprocess.run(
        [sys.executable, "-m", "appliance.cli.healthy"],
        env={**os.environ, "ROSRV_STATE": str(appliance.state)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (health.returncode, PAUSED in health.stderr) == (1, True), health
    for path in ("/v1/status", "/metrics", "/readyz"):
        answer = get(path)
        assert (answer.status, b"paused" in answer.body) == (503, True), answer
    assert time.monotonic() - began < allowed(5.0)


def stopped(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


def test_a_cut_between_the_active_appliance_and_the_robot(site: StandbySite, robot: StandbyRobot) -> None:
    active, passive = site.pair()
    with site.without_link((ADDRESSES[active], ROBOT)):
        site.until_taken_over(passive)
        robot.lost_nothing()


def test_a_port_of_the_replication_that_is_in_use(site: StandbySite, robot: StandbyRobot) -> None:
    active, passive = site.pair()
    host = site.appliances[passive].host
    assert isinstance(host, Host)
    with host.run(lambda: socket.create_server(("", PORT))):
        site.cut(active)
        site.until_taken_over(passive)
        site.restore(active)
        robot.lost_nothing()
        found = site.appliances[passive].ask(standby_requests.StandbyWanted())
        assert found.other.reason == f"the standby cannot connect to port {PORT}: Address already in use"
        assert site.in_sync() == {passive}


def test_the_death_of_the_witness(site: StandbySite, robot: StandbyRobot) -> None:
    pair = site.pair()
    site.stop_witness()
    wait(3 * EXPIRY)
    robot.lost_nothing()
    site.start_witness()
    wait(EXPIRY)
    assert site.pair() == pair


def test_flapping_links(site: StandbySite, robot: StandbyRobot) -> None:
    for pause in (0.1, 0.4, 0.7, 1.3, 0.2, 1.0):
        active, _ = site.pair()
        for ends in ((ADDRESSES["a"], ADDRESSES["b"]), (ADDRESSES[active], ROBOT)):
            with site.without_link(ends):
                wait(pause)
    robot.lost_nothing()


def test_a_boot_of_the_robot(site: StandbySite, robot: StandbyRobot) -> None:
    pair = site.pair()
    robot.cut()
    robot.boot()
    assert site.pair() == pair


def test_a_boot_of_the_robot_while_the_standby_is_off(site: StandbySite, robot: StandbyRobot) -> None:
    """The state in memory stays, such as holders of groups: no other appliance can have been active."""
    active, passive = site.pair()
    site.cut(passive)
    eventually(lambda: site.in_sync() == {active}, site.story)
    epoch, before = site.lease.read().epoch, site.pids(active)
    robot.cut()
    wait(15.0)
    robot.boot()
    assert (site.lease.read().epoch, site.pids(active)) == (epoch, before)
    site.restore(passive)
    site.until_both_in_sync()


@pytest.mark.parametrize("order", ["robot first", "appliances first"])
def test_a_power_cut_of_all_three(site: StandbySite, robot: StandbyRobot, order: str) -> None:
    for name in ADDRESSES:
        site.cut(name)
    robot.cut()
    if order == "robot first":
        site.boot_robot()
    for name in ADDRESSES:
        site.restore(name)
    if order == "appliances first":
        wait(2 * EXPIRY)
        roles = [one.ask(standby_requests.StandbyWanted()).role for one in site.appliances.values()]
        assert roles == ["standby", "standby"]
    else:
        site.stop_witness()
    robot.boot()


def wait(seconds: float) -> None:
    threading.Event().wait(seconds)
