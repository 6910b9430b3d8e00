import socket
import ssl
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import httpx
import psycopg
import pytest

from fleet.tests.support.fleet_site import FleetRobot, FleetSite, running
from tests.support.processes import LIMIT
from tests.support.waiting import eventually

MakeRobot = Callable[..., FleetRobot]


@pytest.fixture
def narrow(database: str, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[FleetSite]:
    limits = {"robot_connections": 3, "address_connections": 6, "header_seconds": request.param}
    with running(FleetSite(tmp_path / "site", database, limits)) as found:
        yield found


def _connect(site: FleetSite, source: str = "127.0.0.1") -> socket.socket:
    return socket.create_connection(("127.0.0.1", site.port), 30, (source, 0))


def _is_closed(connection: socket.socket) -> bool:
    connection.settimeout(1.0)
    try:
        return connection.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionResetError:
        return True


def _is_held(connection: ssl.SSLSocket) -> bool:
    connection.settimeout(LIMIT)
    try:
        connection.sendall(b"GET /v1/bundles/x HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET ")
        return connection.recv(1) != b""
    except (ConnectionResetError, BrokenPipeError):
        return False


def _is_healthy(site: FleetSite) -> bool:
    try:
        return site.get("/healthz", token=None).status_code == 200
    except httpx.TransportError:
        return False


@pytest.mark.parametrize("narrow", [10.0], indirect=True)
def test_an_address_has_a_limit_of_connections(narrow: FleetSite) -> None:
    context = ssl.create_default_context(cafile=narrow.server.ca)
    with ExitStack() as stack:
        many = [stack.enter_context(_connect(narrow)) for _ in range(10)]
        assert sum(map(_is_closed, many)) >= 4
        other = stack.enter_context(_connect(narrow, "127.0.0.2"))
        secure = stack.enter_context(context.wrap_socket(other, server_hostname="127.0.0.1"))
        secure.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert secure.recv(100).startswith(b"HTTP/1.1 200")
        # A handshake that never ends is cut off, long before asyncio's limit of a minute.
        eventually(lambda: all(map(_is_closed, many)), "handshakes without an end are cut off", 30)
    eventually(lambda: _is_healthy(narrow), "later connections are served")


@pytest.mark.parametrize("narrow", [120.0], indirect=True)
def test_a_known_robot_comes_in_beside_the_handshakes_of_its_address(narrow: FleetSite) -> None:
    robot = FleetRobot(narrow, "arm")
    context = ssl.create_default_context(cafile=narrow.server.ca)
    context.load_cert_chain(robot.certificates.certificate, robot.certificates.key)
    with ExitStack() as stack:
        waiting = [stack.enter_context(_connect(narrow)) for _ in range(7)]
        assert not any(map(_is_closed, waiting)), "an address that no robot has come from has six"
        tls = stack.enter_context(
            context.wrap_socket(stack.enter_context(_connect(narrow)), server_hostname="127.0.0.1")
        )
        assert _is_held(tls)
        assert any(map(_is_closed, [stack.enter_context(_connect(narrow)) for _ in range(7)]))
    robot.close()


@pytest.mark.parametrize("narrow", [120.0], indirect=True)
def test_a_robot_has_a_limit_of_connections(narrow: FleetSite) -> None:
    bad, good = FleetRobot(narrow, "bad"), FleetRobot(narrow, "good")
    context = ssl.create_default_context(cafile=narrow.server.ca)
    context.load_cert_chain(bad.certificates.certificate, bad.certificates.key)
    with ExitStack() as stack:
        held = 0
        for _ in range(12):
            plain = stack.enter_context(_connect(narrow))
            tls = stack.enter_context(context.wrap_socket(plain, server_hostname="127.0.0.1"))
            held += _is_held(tls)
        assert held == 3
        good.record(5)
        good.push()
        assert narrow.get("/healthz", token=None).status_code == 200
    bad.close()
    good.close()


def test_the_limit_of_open_files_bounds_connections(database: str, tmp_path: Path) -> None:
    site = FleetSite(tmp_path / "site", database, {"connections": 4000})
    wrapped = ["prlimit", "--nofile=300:400", *site.command("serve")]
    site.command = lambda *_arguments: wrapped  # type: ignore[method-assign]  # the same, with a smaller limit
    with running(site):
        limits = Path(f"/proc/{site.pid}/limits").read_text()
        assert [line.split()[3] for line in limits.splitlines() if line.startswith("Max open files")] == [
            "400"
        ]
        assert "the limit of open files permits fewer connections" in (site.folder / "log").read_text()


def test_slow_searches_delay_no_other_work(site: FleetSite, make_robot: MakeRobot) -> None:
    other = site.run("token", "add", "other").stdout.strip()
    robot = make_robot("arm1")
    robot.record(5)
    robot.push()
    site.indexed()
    with psycopg.connect(site.database) as connection, ThreadPoolExecutor(60) as pool:
        connection.execute("LOCK TABLE record IN ACCESS EXCLUSIVE MODE")
        hanging = [pool.submit(site.get, "/v1/search") for _ in range(60)]
        refused = [
            one
            for one in eventually(lambda: _done(hanging, 58), "more searches of this token are refused", 30)
            if one.status_code == 429
        ]
        assert len(refused) >= 58 - 4  # a search may have timed out by now
        assert all(one.headers["Retry-After"] == "2" for one in refused)
        robot.record(5)
        robot.push()
        for path in ("/healthz", "/v1/health", "/metrics", "/login"):
            assert site.get(path).status_code == 200
        mine = pool.submit(site.get, "/v1/search", other)
        connection.rollback()
        assert mine.result(60).status_code == 200
    site.indexed()
    assert len(site.search(event="decision")) == 10


def _done(futures: list[Future[httpx.Response]], count: int) -> list[httpx.Response]:
    found = [future.result() for future in futures if future.done()]
    return found if len(found) >= count else []
