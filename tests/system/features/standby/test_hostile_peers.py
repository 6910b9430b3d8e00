import asyncio
import contextlib
import os
import secrets
import signal
import socket
import ssl
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.features.standby.first_join import WITNESS_PORT
from appliance.features.standby.link_certificates import replication_context
from appliance.features.standby.membership import PORT, load_membership, path_of
from appliance.features.standby.replication_frames import FromActive, ReplicationLink, SnapshotEnd, Stored
from examples.landshark.lab import INTERFACE, Host
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import ADDRESSES, ROBOT, StandbySite
from tests.support.small_disk import small_disk
from tests.support.waiting import allowed, eventually


@pytest.fixture(autouse=True)
def nothing_is_lost(site: StandbySite, robot: StandbyRobot) -> Iterator[None]:
    site.until_both_in_sync()
    before = site.pair()
    control = site.pids(before[0], "control")
    yield
    site.until_both_in_sync()
    robot.lost_nothing()
    assert site.pair() == before
    assert robot.admitted() == {ADDRESSES[before[0]]}
    assert site.pids(before[0], "control") == control


# ---- A full disk


def test_a_full_disk_of_the_standby(site: StandbySite, robot: StandbyRobot) -> None:
    active, passive = site.pair()
    one = site.appliances[passive]
    one.stop()
    moved = one.directory / "moved"
    one.state.rename(moved)
    try:
        with small_disk(one.state, "96m", "mode=711"):
            subprocess.run(["cp", "-a", f"{moved}/.", str(one.state)], check=True)
            site.start(passive)
            site.until_both_in_sync()
            filler = one.state / "filler"
            with filler.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space"):
                while True:
                    file.write(bytes(1 << 16))
            began = time.monotonic()
            grow(robot, site, lambda: site.in_sync() == {active})
            robot.lost_nothing()
            assert slowest_answer(robot, began) < allowed(2.0)
            filler.unlink()
            site.until_both_in_sync()
            one.stop()
    finally:
        one.stop()
        one.state.rmdir()
        moved.rename(one.state)
        site.start(passive)


def grow(robot: StandbyRobot, site: StandbySite, until: Callable[[], bool]) -> None:
    robot.registrar.send("time")
    eventually(until, site.story)
    robot.registrar.send("rest")


def slowest_answer(robot: StandbyRobot, since: float) -> float:
    events = robot.registrar.seen(event="acknowledged")
    return float(max(event["longest"] for event in events if event["at"] >= since))


# ---- A standby that lies


class Liar:
    def __init__(self, site: StandbySite, folder: Path, *, certificate: bool = True) -> None:
        _, self.name = site.pair()
        self.host: Host = site.lab.hosts[self.name]
        membership = load_membership(path_of(site.appliances[self.name].state))
        assert membership is not None
        self.active = membership.other_address
        if certificate:
            self.context = replication_context(membership, folder, server=False)
        else:
            self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            self.context.check_hostname = False
            self.context.verify_mode = ssl.CERT_NONE

    def run(self, talk: Callable[[ReplicationLink[Any]], Any]) -> Any:
        async def work() -> Any:
            sock = self.host.run(lambda: socket.create_connection((self.active, PORT), 10))
            sock.setblocking(False)
            reader, writer = await asyncio.open_connection(sock=sock, ssl=self.context, server_hostname="")
            link: ReplicationLink[Any] = ReplicationLink(reader, writer, FromActive)
            try:
                return await asyncio.wait_for(talk(link), 30)
            finally:
                await link.close()

        return asyncio.run(work())


@contextlib.contextmanager
def standby_replaced(site: StandbySite, folder: Path) -> Iterator[Liar]:
    active, passive = site.pair()
    site.signal(passive, signal.SIGKILL)
    eventually(lambda: site.in_sync() == {active}, site.story)
    try:
        yield Liar(site, folder)
    finally:
        site.restore(passive)


def test_a_standby_that_lies(site: StandbySite, robot: StandbyRobot, tmp_path: Path) -> None:
    active, _ = site.pair()
    with standby_replaced(site, tmp_path) as liar:
        for false in (
            lambda history: Stored(1, history, 1 << 60),
            lambda _history: Stored(1, "another", 1),
            lambda _history: "garbage",
            lambda _history: b"\x93" * 4096,
        ):
            assert liar.run(lambda link, lie=false: lied(link, lie)) is True  # type: ignore[misc]  # mypy infers no type for a lambda's default
        robot.works()
        assert site.in_sync() == {active}
        liar.run(lambda link: reads_nothing(link, robot))
        assert site.in_sync() == {active}
        robot.lost_nothing()


async def lied(link: ReplicationLink[Any], lie: Callable[[str], Any]) -> bool:
    await link.send(Stored(0, "", 0))
    begin = await link.receive(10)
    while not isinstance(await link.receive(10), SnapshotEnd):
        pass
    await link.send(lie(begin.history))
    with contextlib.suppress(Exception):
        while True:
            await link.receive(10)
    return True


async def reads_nothing(link: ReplicationLink[Any], robot: StandbyRobot) -> None:
    await link.send(Stored(0, "", 0))
    await asyncio.to_thread(robot.works)


def test_a_client_without_the_certificate(site: StandbySite, tmp_path: Path) -> None:
    stranger = Liar(site, tmp_path, certificate=False)

    async def ask(link: ReplicationLink[Any]) -> Any:
        await link.send(Stored(0, "", 0))
        return await link.receive(10)

    with pytest.raises(Exception, match=r"(?i)certificate required|closed the link|the link was lost"):
        stranger.run(ask)


# ---- An attacker on the robot's network


def test_floods_and_replayed_datagrams(site: StandbySite, robot: StandbyRobot) -> None:
    attacker = site.lab.host("attacker", "10.79.0.66/24")
    recorded = record(site, 40)
    assert {port_of(one) for one in recorded} >= {PORT, WITNESS_PORT}
    ended = threading.Event()
    flood = threading.Thread(target=lambda: attacker.run(lambda: send_always(recorded, ended)))
    flood.start()
    try:
        robot.lost_nothing()
        threading.Event().wait(3.0)
        robot.lost_nothing()
    finally:
        ended.set()
        flood.join()
    refused = attacker.run(lambda: [connects(address) for address in ADDRESSES.values()])
    assert refused == [False, False]


def connects(address: str) -> bool:
    try:
        with socket.create_connection((address, PORT), 1.0):
            return True
    except OSError:
        return False


def record(site: StandbySite, number: int) -> list[bytes]:
    def listen() -> list[bytes]:
        found: list[bytes] = []
        with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3)) as sock:
            sock.settimeout(10)
            while len(found) < number:
                frame = sock.recv(2048)
                if (
                    frame[12:14] == b"\x08\x00"
                    and frame[23] == socket.IPPROTO_UDP
                    and port_of(frame) in (PORT, WITNESS_PORT)
                ):
                    found.append(frame)
        return found

    return site.lab.switch.run(listen)


def port_of(frame: bytes) -> int:
    start = 14 + 4 * (frame[14] & 15)
    port: int = struct.unpack_from("!H", frame, start + 2)[0]
    return port


def send_always(recorded: list[bytes], ended: threading.Event) -> None:
    own = bytes.fromhex(Path(f"/sys/class/net/{INTERFACE}/address").read_text().replace(":", ""))
    frames = [frame[:6] + own + frame[12:] for frame in recorded]
    frames += [frame[:-1] + bytes([frame[-1] ^ 1]) for frame in frames]
    with (
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as raw,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plain,
    ):
        raw.bind((INTERFACE, 0))
        while not ended.is_set():
            for frame in frames:
                with contextlib.suppress(OSError):
                    raw.send(frame)
            for address in ((ROBOT, WITNESS_PORT), *((one, PORT) for one in ADDRESSES.values())):
                with contextlib.suppress(OSError):
                    plain.sendto(secrets.token_bytes(secrets.randbelow(1400)), address)
            os.sched_yield()
