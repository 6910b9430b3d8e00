import os
import signal
import ssl
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.appliance import Appliance
from tests.support.processes import LIMIT
from tests.support.rest import Rest
from tests.support.waiting import allowed, eventually


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    with Appliance(options=("--api", "127.0.0.1:0", "--api-tls", "off")) as running:
        yield running


def seconds_of_a_call(appliance: Appliance) -> float:
    began = time.monotonic()
    with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
        answer = master.getSystemState("/tester")
    assert isinstance(answer, list)
    assert answer[0] == 1
    return time.monotonic() - began


def process_row(appliance: Appliance, role: str) -> dict[str, Any]:
    rows: list[dict[str, Any]] = appliance.status()["processes"]
    return next(row for row in rows if row["role"] == role)


def unchanged(appliance: Appliance, row: dict[str, Any]) -> bool:
    now = process_row(appliance, row["role"])
    return (now["pid"], now["restarts"]) == (row["pid"], row["restarts"])


def until_another(appliance: Appliance, role: str, pid: int) -> None:
    eventually(lambda: appliance.pids(role) not in ([], [pid]), appliance.story)


def test_a_killed_api_is_replaced(appliance: Appliance) -> None:
    rest = appliance.rest()
    assert rest.get("/v1/status").status == 200
    control, api = process_row(appliance, "control"), process_row(appliance, "api")
    for _ in range(3):
        pid = appliance.kill("api")
        assert seconds_of_a_call(appliance) < allowed(5)
        assert rest.get("/v1/status").status in (
            200,
            503,
        )  # waits in the kernel's queue; gets 503 until control is connected
        until_another(appliance, "api", pid)
    assert unchanged(appliance, control)
    assert process_row(appliance, "api")["restarts"] == api["restarts"] + 3
    eventually(lambda: rest.get("/readyz").status == 200, appliance.story)
    assert rest.get("/v1/status").status == 200


def test_a_hanging_api_is_replaced(appliance: Appliance) -> None:
    assert appliance.rest().get("/healthz").status == 200
    pid = appliance.pids("api")[0]
    os.kill(pid, signal.SIGSTOP)
    assert seconds_of_a_call(appliance) < allowed(5)
    until_another(appliance, "api", pid)
    assert appliance.rest().get("/healthz").status == 200


def test_rest_outlives_control(appliance: Appliance) -> None:
    rest = appliance.rest()
    assert rest.get("/v1/status").status == 200
    api = appliance.pids("api")[0]
    appliance.kill("control")
    deadline = time.monotonic() + 2 * LIMIT
    while (answer := rest.get("/v1/status")).status != 200:
        assert answer.status in (503, 401)
        assert answer.headers["content-type"] == "application/problem+json"
        assert time.monotonic() < deadline
    assert appliance.pids("api") == [api]


def test_a_flood_of_rest_does_not_affect_rvmaster(appliance: Appliance) -> None:
    rest, control = appliance.rest(), process_row(appliance, "control")
    program = (
        "import socket, sys, time\n" "end = time.monotonic() + 4\n" "held = []\n" "while time.monotonic() < end:\n"
        "    try:\n" "        one = socket.create_connection(('127.0.0.1', int(sys.argv[1])), 1)\n"
        "        one.sendall(b'POST /v1/policy HTTP/1.1\\r\\nHost: ::1\\r\\nContent-Length: 9\\r\\n\\r\\n[Nodes]')\n"
        "        held = [*held[-200:], one]\n" "    except OSError:\n" "        pass\n"
    )  # fmt: skip
    floods = [subprocess.Popen([sys.executable, "-c", program, str(rest.url.port)]) for _ in range(2)]
    try:
        times = []
        while all(flood.poll() is None for flood in floods):
            times.append(seconds_of_a_call(appliance))
    finally:
        for flood in floods:
            flood.kill()
            flood.wait()
    assert times
    assert max(times) < allowed(3), times
    assert unchanged(appliance, control)
    eventually(lambda: answers(rest), "REST takes a connection again: the flood held all of this address")


def answers(rest: Rest) -> bool:
    try:
        return rest.get("/healthz").status == 200
    except OSError:
        return False


def test_an_api_that_cannot_serve_does_not_end_the_appliance() -> None:
    with Appliance(options=("--api", "127.0.0.1:0")) as appliance:
        appliance.rest()
        appliance.stop()
        certificate = appliance.state / "api" / "certificate.pem"
        right = certificate.read_text()
        certificate.write_text("nonsense")
        appliance.start()
        assert appliance.process is not None
        deadline = time.monotonic() + 2 * LIMIT
        while not any("REST cannot be served" in line for line in list(appliance.process.errors)):
            assert time.monotonic() < deadline, appliance.story()
            assert seconds_of_a_call(appliance) < allowed(5)
        assert process_row(appliance, "control")["restarts"] == 0
        certificate.write_text(right)
        ssl.get_server_certificate(("127.0.0.1", int(appliance.ready["api"].rpartition(":")[2])), timeout=30)
