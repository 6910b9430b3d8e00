import os
import select
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.network.firewall.firewall import BackendChoice, Firewall
from appliance.network.firewall.firewall_rules import FirewallSettings
from appliance.network.probe import probe_port
from examples.landshark.lab import Host, Lab
from tests.support.requirements import need_program

CONTROL, ROSMASTER, OTHER = 61011, 61012, 61055
PORT = 11312

ASK = """
import sys, xmlrpc.client
try:
    print(xmlrpc.client.ServerProxy(sys.argv[1]).getPid("/test"))
except OSError as error:
    print(type(error).__name__)
"""


@pytest.fixture
def host(lab: Lab) -> Host:
    return lab.host("host", "10.77.0.2/24", "fd77::2/64")


@pytest.fixture
def master(host: Host, tmp_path: Path) -> "Iterator[subprocess.Popen[str]]":
    program = need_program("rosmaster", "python3-rosmaster")
    os.chown(tmp_path, ROSMASTER, ROSMASTER)
    for folder in (tmp_path, *list(tmp_path.parents)[:2]):
        folder.chmod(folder.stat().st_mode | 0o711)
    process = host.popen(
        [program, "--core", "-p", str(PORT)],
        user=ROSMASTER,
        group=ROSMASTER,
        extra_groups=[],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd="/",
        env={
            "PATH": os.environ["PATH"],
            "ROS_IP": "127.0.0.1",
            "ROS_MASTER_URI": f"http://127.0.0.1:{PORT}",
            "ROS_LOG_DIR": str(tmp_path),
            "HOME": str(tmp_path),
            "PYTHONUNBUFFERED": "1",
        },
    )
    assert process.stdout is not None
    wait_until_listening(host, process)
    yield process
    process.terminate()
    process.wait(timeout=20)
    process.stdout.close()


def wait_until_listening(host: Host, process: "subprocess.Popen[str]") -> None:
    for _ in range(300):
        with host.entered(), socket.socket() as client:
            if client.connect_ex(("127.0.0.1", PORT)) == 0:
                return
        assert process.poll() is None
        select.select([], [], [], 0.1)
    pytest.fail("rosmaster did not listen within 30 s")


def ask(host: Host, uid: int, uri: str) -> str:
    process = host.popen(
        ["/usr/bin/python3", "-I", "-c", ASK, uri],
        user=uid,
        group=uid,
        extra_groups=[],
        cwd="/",
        stdout=subprocess.PIPE,
        text=True,
    )
    return str(process.communicate(timeout=60)[0]).strip()


@pytest.mark.real
@pytest.mark.parametrize("backend", ["nft", "iptables"])
def test_control_alone_talks_to_the_real_rosmaster(
    host: Host, master: "subprocess.Popen[str]", backend: BackendChoice
) -> None:
    loopback = f"http://127.0.0.1:{PORT}/"
    answer = f"[1, '', {master.pid}]"
    assert ask(host, OTHER, loopback) == answer, "before the firewall"
    Firewall(host.namespace, backend).install(
        FirewallSettings(control_uid=CONTROL, rosmaster_uid=ROSMASTER, rosmaster_port=PORT)
    )
    assert ask(host, CONTROL, loopback) == answer
    for uid in (0, ROSMASTER, OTHER):
        for uri in (loopback, f"http://[::1]:{PORT}/", f"http://{host.address}:{PORT}/"):
            assert ask(host, uid, uri) == "ConnectionRefusedError", (uid, uri)
    result = probe_port(host.namespace, PORT)
    assert result.closed
    assert result.listening == ("127.0.0.1",)
