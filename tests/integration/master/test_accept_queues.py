import contextlib
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from roswire.xmlrpc import Value, build_call, parse_response
from tests.support.appliance import Appliance
from tests.support.nodes import need_ros
from tests.support.requirements import need_root

WAIT = 30.0
POLICY = """\
[Groups]
team = 10.77.0.10 fd77::10
[Nodes]
default = team
/guest/** = *
[Commands]
default = *
"""
SOMAXCONN = Path("/proc/sys/net/core/somaxconn")


@pytest.fixture
def lab() -> Iterator[Lab]:
    need_root()
    need_ros()
    with Lab("rosrv-test") as lab:
        yield lab


def call(host: Host, target: str, source: str = "") -> Value:
    with connect(host, target, source, WAIT) as sock:
        return ask(sock)


def connect(host: Host, target: str, source: str, seconds: float) -> socket.socket:
    with host.entered():
        return socket.create_connection((target, 11311), seconds, source_address=(source, 0))


def ask(sock: socket.socket) -> Value:
    body = build_call("getParam", ("/looker", "/rosdistro"))
    sock.settimeout(WAIT)
    sock.sendall(b"POST / HTTP/1.0\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))
    with sock.makefile("rb") as answer:
        return parse_response(answer.read().partition(b"\r\n\r\n")[2])


@pytest.mark.parametrize(
    ("target", "robot", "crowd"),
    [("10.77.0.2", "10.77.0.10", "10.77.2.{}"), ("fd77::2", "fd77::10", "fd77::2:{}")],
)
def test_a_full_queue_of_unknown_hosts(lab: Lab, target: str, robot: str, crowd: str) -> None:
    length = 64 if ":" in target else 16
    unknown_hosts = [crowd.format(number) for number in range(1, 201)]
    middle = lab.host("appliance", f"{target}/{length}")
    robots = lab.host("robot", f"{robot}/{length}")
    crowds = lab.host("crowd", *(f"{address}/{length}" for address in unknown_hosts))
    with middle.entered():
        SOMAXCONN.write_text("128")
    listen = f"[{target}]:11311" if ":" in target else f"{target}:11311"
    with (
        Appliance(middle, policy=POLICY, options=("--listen", listen)) as appliance,
        contextlib.ExitStack() as held,
    ):
        assert call(crowds, target, unknown_hosts[0]) == call(robots, target, robot)
        control = appliance.pids("control")[0]
        os.kill(control, signal.SIGSTOP)
        try:
            with pytest.raises(TimeoutError):
                for address in unknown_hosts:
                    held.enter_context(connect(crowds, target, address, 0.5))
            waiting = held.enter_context(connect(robots, target, robot, WAIT))
        finally:
            os.kill(control, signal.SIGCONT)
        assert ask(waiting) == call(crowds, target, unknown_hosts[0])
        assert appliance.pids("control") == [control]
