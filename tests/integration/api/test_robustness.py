"""RVMaster does not notice what becomes of the api: killed, stopped, flooded; nor REST much of a control that dies."""

import os
import signal
import socket
import ssl
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance
from tests.support.requirements import need_root
from tests.support.waiting import allowed, eventually


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    """An appliance with REST in clear text on a free port; each test leaves all its processes at work."""
    with Appliance(options=("--api", "127.0.0.1:0", "--api-tls", "off")) as running:
        yield running


def seconds_of_a_call(appliance: Appliance) -> float:
    """How long RVMaster takes to answer; it must answer rightly."""
    began = time.monotonic()
    with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
        answer = master.getSystemState("/tester")
    assert isinstance(answer, list)
    assert answer[0] == 1
    return time.monotonic() - began


def process_row(appliance: Appliance, role: str) -> dict[str, Any]:
    """A process, by `rosrv status`."""
    rows: list[dict[str, Any]] = appliance.status()["processes"]
    return next(one for one in rows if one["role"] == role)


def unchanged(appliance: Appliance, row: dict[str, Any]) -> bool:
    """Whether the process of this row still runs, and none was started in its place."""
    now = process_row(appliance, row["role"])
    return (now["pid"], now["restarts"]) == (row["pid"], row["restarts"])


def until_another(appliance: Appliance, role: str, pid: int) -> None:
    """Wait until a process of the role runs that is not this one."""
    eventually(lambda: appliance.pids(role) not in ([], [pid]), appliance.story)


def test_a_killed_api_costs_nothing_but_a_moment(appliance: Appliance) -> None:
    """RVMaster answers all the while and is not restarted; the port stays open: a request waits for the next api."""
    rest = appliance.rest()
    assert rest.get("/v1/status").status == 200
    control, api = process_row(appliance, "control"), process_row(appliance, "api")
    for _ in range(3):
        pid = appliance.kill("api")
        assert seconds_of_a_call(appliance) < allowed(5)
        assert rest.get("/v1/status").status in (
            200,
            503,
        )  # waits in the kernel's queue; 503 before control's word
        until_another(appliance, "api", pid)
    assert unchanged(appliance, control)
    assert process_row(appliance, "api")["restarts"] == api["restarts"] + 3
    for _ in range(100):
        if rest.get("/readyz").status == 200:
            break
    assert rest.get("/v1/status").status == 200


def test_a_hanging_api_is_replaced(appliance: Appliance) -> None:
    """An api that does not answer its supervisor is killed and started again; RVMaster answers meanwhile."""
    assert appliance.rest().get("/healthz").status == 200
    pid = appliance.pids("api")[0]
    os.kill(pid, signal.SIGSTOP)
    assert seconds_of_a_call(appliance) < allowed(5)
    until_another(appliance, "api", pid)
    assert appliance.rest().get("/healthz").status == 200


def test_rest_outlives_control(appliance: Appliance) -> None:
    """While control is started again REST answers 503 with a problem; then as before, with the same tokens."""
    rest = appliance.rest()
    assert rest.get("/v1/status").status == 200
    api = appliance.pids("api")[0]
    appliance.kill("control")
    deadline = time.monotonic() + 30
    while (answer := rest.get("/v1/status")).status != 200:
        assert answer.status in (503, 401)
        assert answer.headers["content-type"] == "application/problem+json"
        assert time.monotonic() < deadline
    assert appliance.pids("api") == [api]


def test_a_flood_is_not_rvmasters_problem(appliance: Appliance) -> None:
    """While connections and requests pour in on REST, RVMaster answers as before."""
    rest, control = appliance.rest(), process_row(appliance, "control")
    program = (
        "import socket, sys, time\n"
        "end = time.monotonic() + 4\n"
        "held = []\n"
        "while time.monotonic() < end:\n"
        "    try:\n"
        "        one = socket.create_connection(('127.0.0.1', int(sys.argv[1])), 1)\n"
        "        one.sendall(b'POST /v1/policy HTTP/1.1\\r\\nHost: ::1\\r\\nContent-Length: 9\\r\\n\\r\\n[Nodes]')\n"
        "        held = [*held[-200:], one]\n"
        "    except OSError:\n"
        "        pass\n"
    )
    floods = [subprocess.Popen([sys.executable, "-c", program, str(rest.url.port)]) for _ in range(2)]
    try:
        times = []
        while all(one.poll() is None for one in floods):
            times.append(seconds_of_a_call(appliance))
    finally:
        for one in floods:
            one.kill()
            one.wait()
    assert times
    assert max(times) < allowed(3), times
    assert unchanged(appliance, control)


def test_nonsense_on_the_port_harms_nobody(appliance: Appliance) -> None:
    """Bytes that are no HTTP, headers without end, a request cut in the middle: the next client is served."""
    rest, api = appliance.rest(), process_row(appliance, "api")
    for data in (
        b"\x16\x03\x01\x02\x00garbage", b"GET / HTTP/1.1\r\nA: " + b"x" * 200_000, b"GET /v1/status HT",
        b"POST /v1/policy HTTP/1.1\r\nTransfer-Encoding: chunked\r\nContent-Length: 5\r\n\r\nzz\r\n",
        b"GET http://evil/ HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil\r\n\r\n", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"GET /v1/status HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n",
    ):  # fmt: skip
        assert rest.url.hostname is not None
        with socket.create_connection((rest.url.hostname, rest.url.port), 5) as one:
            try:
                one.sendall(data)
                one.shutdown(socket.SHUT_WR)
                while one.recv(65_536):
                    pass
            except (TimeoutError, ConnectionError):
                pass
        assert rest.get("/v1/status").status == 200
    assert unchanged(appliance, api)


def test_the_api_may_read_the_audit_log_and_nothing_more(appliance: Appliance) -> None:
    """As root: it runs as its own user, may read the log, may not write it, nor read tokens, keys or the state."""
    need_root()
    assert appliance.rest().get("/v1/audit").status == 200
    lines = Path(f"/proc/{appliance.pids('api')[0]}/status").read_text().splitlines()
    fields = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    user, group = int(fields["Uid"].split()[0]), int(fields["Gid"].split()[0])
    assert user not in (0, int(appliance.state.joinpath("control").stat().st_uid))
    assert int(fields["CapEff"], 16) == 0

    def may(flag: str, path: str) -> bool:
        command = ["/usr/bin/test", flag, str(appliance.state / path)]
        return subprocess.run(command, user=user, group=group, extra_groups=[], check=False).returncode == 0

    assert may("-r", "control/audit.db")
    for path in ("control/audit.db", "control/audit.db-wal", "control/audit.db-shm", "control"):
        assert not may("-w", path), path
    for path in (
        "control",
        "control/state.db",
        "control/state.db-wal",
        "signer",
        "signer/audit.key",
        "relay",
    ):
        assert not may("-r", path), path


def test_an_api_that_cannot_serve_does_not_end_the_appliance() -> None:
    """A damaged certificate: the log says what is wrong with REST, and nodes are served; mended, REST is back."""
    with Appliance(options=("--api", "127.0.0.1:0")) as appliance:
        appliance.rest()
        appliance.stop()
        certificate = appliance.state / "api" / "certificate.pem"
        right = certificate.read_text()
        certificate.write_text("nonsense")
        appliance.start()
        assert appliance.process is not None
        deadline = time.monotonic() + 30
        while not any("REST cannot be served" in line for line in list(appliance.process.errors)):
            assert time.monotonic() < deadline, appliance.story()
            assert seconds_of_a_call(appliance) < allowed(5)
        assert process_row(appliance, "control")["restarts"] == 0
        certificate.write_text(right)
        ssl.get_server_certificate(("127.0.0.1", int(appliance.ready["api"].rpartition(":")[2])), timeout=30)
