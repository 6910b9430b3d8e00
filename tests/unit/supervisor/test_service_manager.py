import asyncio
import os
import socket
import threading
from pathlib import Path

import pytest

from appliance.supervisor.service_manager import ServiceManager


def listening(path: Path) -> socket.socket:
    heard = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    heard.bind(str(path))
    heard.settimeout(10)
    return heard


@pytest.mark.nightly
def test_start_ready_and_stop_are_reported(tmp_path: Path) -> None:
    with listening(tmp_path / "notify") as heard:
        manager = ServiceManager.of({"NOTIFY_SOCKET": str(tmp_path / "notify")})
        manager.starting("builds its firewall")
        manager.ready("nodes may connect")
        manager.stopping()
        assert heard.recv(4096) == b"EXTEND_TIMEOUT_USEC=120000000\nSTATUS=builds its firewall"
        assert heard.recv(4096) == b"READY=1\nSTATUS=nodes may connect"
        assert heard.recv(4096).startswith(b"STOPPING=1\n")


@pytest.mark.nightly
def test_the_watchdog_is_fed_twice_in_its_time(tmp_path: Path) -> None:
    environment = {
        "NOTIFY_SOCKET": str(tmp_path / "notify"),
        "WATCHDOG_USEC": "20000",
        "WATCHDOG_PID": str(os.getpid()),
    }

    async def live(manager: ServiceManager, heard: socket.socket) -> tuple[bytes, bytes]:
        async with manager.watch():
            first = await asyncio.to_thread(heard.recv, 4096)
            manager.ready("nodes may connect")
            while not (await asyncio.to_thread(heard.recv, 4096)).startswith(b"READY=1"):
                pass
            return first, await asyncio.to_thread(heard.recv, 4096)

    with listening(tmp_path / "notify") as heard:
        manager = ServiceManager.of(environment)
        assert manager.watchdog_seconds == 0.02
        starting, running = asyncio.run(live(manager, heard))
    assert starting == b"EXTEND_TIMEOUT_USEC=120000000\nWATCHDOG=1"
    assert running == b"READY=1\nWATCHDOG=1"
    assert environment == {}, "a child must not speak in its place"


@pytest.mark.nightly
def test_a_service_manager_that_does_not_read_delays_nothing(tmp_path: Path) -> None:
    with listening(tmp_path / "notify"):
        manager = ServiceManager.of({"NOTIFY_SOCKET": str(tmp_path / "notify")})

        def say() -> None:
            for _ in range(5000):
                manager.starting("builds its firewall")

        thread = threading.Thread(target=say, daemon=True)
        thread.start()
        thread.join(30)
        assert not thread.is_alive()


def test_without_a_service_manager_nothing_is_sent() -> None:
    manager = ServiceManager.of({"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"})
    manager.ready("nobody hears it")
    assert manager.watchdog_seconds is None


@pytest.mark.nightly
def test_a_service_manager_that_has_gone_stops_nothing(tmp_path: Path) -> None:
    ServiceManager(str(tmp_path / "gone"), None).ready("nobody hears it")
