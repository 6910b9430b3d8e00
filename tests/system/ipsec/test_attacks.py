import contextlib
import os
import queue
import re
import secrets
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from appliance.ipsec.strongswan import USER_SPACE_INTERFACE
from appliance.network import interfaces
from examples.landshark.lab import INTERFACE, Host, Lab
from tests.support.esp_packets import initiators_keys
from tests.support.processes import LIMIT, Event
from tests.support.requirements import need_program, need_root
from tests.support.tunnel_site import ATTACKER, MASTER, MIDDLE, OCU, OWN, TunnelSite
from tests.support.tunnels import JoinedHost, need_strongswan
from tests.support.waiting import allowed
from tests.support.wire import Capture, Frame, send_frames, udp_packet

OTHER = "10.88.0.30"
OTHER_USER = 61055  # a user without other processes


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TunnelSite]:
    need_root()
    need_strongswan()
    need_program("nft", "nftables")
    with Lab("rosrv-attack") as lab, TunnelSite(lab, tmp_path_factory.mktemp("attack")) as one:
        yield one


@pytest.fixture(scope="module")
def kit(site: TunnelSite) -> Path:
    return site.kit()


@pytest.fixture(scope="module")
def other(site: TunnelSite) -> Host:
    return site.lab.host("other", f"{OTHER}/24")


@pytest.fixture(scope="module")
def others_kit(site: TunnelSite) -> Path:
    return site.kit("add", "ocu-2")


_LONG = b"second" * 150  # bytes


class Datagrams:
    def __init__(self, host: Host) -> None:
        with host.entered():
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((OWN, 0))
        self.port: int = self._socket.getsockname()[1]
        self._arrived: queue.SimpleQueue[tuple[bytes, str]] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def next(self) -> tuple[bytes, str]:
        return self._arrived.get(timeout=LIMIT)

    def first_of(self, word: bytes, send: Callable[[bytes], None]) -> str:
        for number in range(int(LIMIT)):
            send(b"%s %d" % (word, number))
            with contextlib.suppress(queue.Empty):
                data, sender = self._arrived.get(timeout=1)
                assert data.startswith(word), data
                return sender
        raise AssertionError(f"{word!r} did not arrive")

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while data := self._socket.recvfrom(2048):
                self._arrived.put((data[0], data[1][0]))

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def datagrams(site: TunnelSite, kit: Path) -> Iterator[Datagrams]:
    host = site.appliance.host
    assert isinstance(host, Host)
    listening = Datagrams(host)
    yield listening
    listening.close()


def send(joined: JoinedHost, port: int, data: bytes) -> None:
    with joined.outer.entered(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((joined.address, 0))
        sender.sendto(data, (OWN, port))


def lab_host(site: TunnelSite) -> Host:
    assert isinstance(site.appliance.host, Host)
    return site.appliance.host


def esp_is_charons(site: TunnelSite) -> bool:
    return USER_SPACE_INTERFACE in interfaces.links(lab_host(site).namespace)


@contextlib.contextmanager
def deaf(host: Host) -> Iterator[None]:
    table = "add table ip hold; add chain ip hold in { type filter hook prerouting priority -400; };"
    _nft(host, table + "add rule ip hold in udp dport 4500 drop")
    try:
        yield
    finally:
        _nft(host, "delete table ip hold")


def _nft(host: Host, command: str) -> None:
    done = host.popen(["nft", command])
    assert done.wait(LIMIT) == 0


def test_replayed_packets_are_refused(site: TunnelSite, kit: Path, datagrams: Datagrams) -> None:
    """A packet does not arrive again, from any source. The log counts the replays where charon sees them."""
    before = site.mark
    with site.joined(kit) as joined, Capture(lab_host(site).namespace) as wire:
        send(joined, datagrams.port, b"first")
        assert datagrams.next() == (b"first", joined.address)
        with deaf(lab_host(site)):
            # Only this packet is so long; the host's own pings are short.
            send(joined, datagrams.port, _LONG)
            taken = wire.wait_for(
                lambda frame: frame.esp and frame.source == OCU and len(frame.udp_payload) > len(_LONG)
            )
        # A packet that has not arrived yet shows that the attacker's packets can arrive.
        again = taken.with_payload(taken.udp_payload)
        send_frames(site.attacker, [again])
        assert datagrams.next() == (_LONG, joined.address)
        sealed = taken.udp_payload
        changed = taken.with_payload(sealed[:-1] + bytes([sealed[-1] ^ 1]))
        newer = taken.with_payload(sealed[:4] + (int.from_bytes(sealed[4:8]) + 9).to_bytes(4) + sealed[8:])
        mark = len(wire.frames)
        send_frames(site.attacker, [again] * 50 + [changed] * 50 + [newer] * 50)
        wire.wait_for(lambda frame: frame.data[14:] == newer[14:], since=mark)
        # charon may still be reading: a full buffer loses some of these, but no repeated packet is among them.
        for _ in range(2):
            sender = datagrams.first_of(b"later", lambda data: send(joined, datagrams.port, data))
            assert sender == joined.address
        if esp_is_charons(site):
            assert site.recorded(before, event="packets refused", host=OCU)["detail"]["packets"] > 0


def test_only_ike_and_esp_are_on_the_wire(site: TunnelSite, kit: Path) -> None:
    with (
        Capture(site.ocu.namespace) as wire,
        site.joined(kit) as joined,
        site.talking(joined) as (_, listener),
    ):
        listener.wait_for_count(20, event="received")
    # A charon that has ended makes the kernel return its late packets: these are also IKE and ESP only.
    packets = [frame.returned or frame for frame in wire.frames if frame.ipv4]
    strange = [frame.data.hex() for frame in packets if frame.protocol != socket.IPPROTO_UDP]
    assert strange == []
    assert {frame.source for frame in packets} | {frame.destination for frame in packets} == {OCU, MIDDLE}
    assert all(set(frame.ports) & {500, 4500} for frame in packets)
    assert len([frame for frame in packets if frame.esp]) > 20
    assert not any(b"hello" in frame.data for frame in wire.frames)
    # Packets other than IPv4 and ARP are the kernel's own IPv6 neighbour discovery.
    rest = [frame for frame in wire.frames if not frame.ipv4 and not frame.arp]
    assert all(frame.data[12:14] == b"\x86\xdd" and frame.data[20] in (0, 58) for frame in rest)


def test_a_host_in_a_tunnel_cannot_send_as_another(
    site: TunnelSite, kit: Path, other: Host, others_kit: Path, datagrams: Datagrams
) -> None:
    with site.joined(kit) as trusted, site.joined(others_kit, other, log="chd = 4") as dishonest:
        assert dishonest.charon is not None
        keys = initiators_keys(dishonest.charon)
        mark = site.mark

        def forge(number: int, source: str, data: bytes) -> None:
            inner = udp_packet((source, 4000), (OWN, datagrams.port), data)
            with other.entered(), socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW) as raw:
                outer = udp_packet((OTHER, 4500), (MIDDLE, 4500), keys.seal(1000 + number, inner))
                raw.sendto(outer, (MIDDLE, 0))

        forge(1, dishonest.address, b"as myself")
        assert datagrams.next() == (b"as myself", dishonest.address)
        for number, source in enumerate((trusted.address, OWN, "10.113.11.99", OTHER, "127.0.0.1")):
            forge(2 + number, source, b"as somebody else")
        forge(20, dishonest.address, b"as myself again")
        assert datagrams.next() == (b"as myself again", dishonest.address)
        send(trusted, datagrams.port, b"the real one")
        assert datagrams.next() == (b"the real one", trusted.address)
        if esp_is_charons(site):
            assert site.recorded(mark, event="packets refused", host=trusted.address)["decision"] == "deny"


def test_a_host_cannot_request_anothers_address(
    site: TunnelSite, kit: Path, other: Host, others_kit: Path
) -> None:
    insisting = site.join(others_kit, other)
    conf = insisting.folder / "swanctl" / "swanctl.conf"
    theirs = site.join(kit).address
    conf.write_text(conf.read_text().replace("vips = 0.0.0.0", f"vips = {theirs}"))
    mark = site.mark
    with insisting:
        insisting.wait_until_up()
        assert site.recorded(mark, event="tunnel up")["host"] == insisting.address != theirs
        mark = site.mark
    site.recorded(mark, event="tunnel down")
    conf.write_text(conf.read_text().replace("local_ts = dynamic", f"local_ts = {theirs}/32"))
    mark = site.mark
    with insisting:
        refused = site.refused(mark, OTHER)
    assert "traffic that is not allowed" in refused["reason"]


def test_the_name_must_match_the_certificate(
    site: TunnelSite, kit: Path, other: Host, others_kit: Path
) -> None:
    thief = site.join(others_kit, other)
    conf = thief.folder / "swanctl" / "swanctl.conf"
    conf.write_text(conf.read_text().replace("id = fqdn:ocu-2", "id = fqdn:ocu-1"))
    mark = site.mark
    with thief:
        refused = site.refused(mark, OTHER)
    assert refused["decision"] == "deny"
    assert site.state() == "down"


def test_a_trusted_address_without_a_tunnel_is_denied(site: TunnelSite, kit: Path) -> None:
    with site.joined(kit) as joined:
        virtual = joined.address
    interfaces.add_address(site.ocu.namespace, INTERFACE, f"{virtual}/32")
    interfaces.add_route(site.ocu.namespace, f"{OWN}/32", MIDDLE)
    try:
        assert _ask(site.ocu, OCU, MIDDLE) == "answered"
        mark = site.mark
        done = site.ocu.popen(
            ["/usr/bin/rostopic", "list"],
            env={"PATH": "/usr/bin:/bin", "ROS_MASTER_URI": MASTER, "ROS_IP": OCU, "HOME": str(site.home)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        assert done.wait(LIMIT) != 0
        assert site.recorded(mark, decision="deny", host=OCU)
        assert _ask(site.ocu, virtual, MIDDLE) == "nothing"
        assert _ask(site.ocu, virtual, OWN) == "nothing"
    finally:
        for command in (
            ["ip", "addr", "del", f"{virtual}/32", "dev", INTERFACE],
            ["ip", "route", "del", f"{OWN}/32"],
        ):
            assert site.ocu.popen(command).wait(LIMIT) == 0


ASK = """
import socket, sys
with socket.socket() as client:
    client.settimeout(3)
    if sys.argv[4] == "free":
        client.setsockopt(socket.SOL_IP, 15, 1)  # IP_FREEBIND
    try:
        client.bind((sys.argv[1], 0))
    except OSError:
        sys.exit(print("not bound"))
    try:
        client.connect((sys.argv[2], int(sys.argv[3])))
    except OSError:
        sys.exit(print("nothing"))
    print("answered")
"""


def _ask(host: Host, source: str, target: str, *, user: int | None = None, free: bool = False) -> str:
    asking = host.popen(
        [sys.executable, "-c", ASK, source, target, "11311", "free" if free else "plain"],
        stdout=subprocess.PIPE,
        text=True,
        user=user,
        extra_groups=None if user is None else [],
    )
    return str(asking.communicate(timeout=LIMIT)[0]).strip()


def test_a_local_program_is_not_a_tunnelled_host(site: TunnelSite, kit: Path) -> None:
    host = lab_host(site)
    with site.joined(kit) as joined:
        assert _ask(host, MIDDLE, MIDDLE, user=OTHER_USER) == "answered", "the destination is reachable"
        assert _ask(host, joined.address, OWN, user=OTHER_USER) == "not bound"
        assert _ask(host, joined.address, OWN, user=OTHER_USER, free=True) == "nothing"
        assert _ask(host, joined.address, MIDDLE, free=True) == "nothing"
        assert _ask(host, OWN, OWN, user=OTHER_USER) == "nothing"
        assert _ask(host, OWN, MIDDLE) == "nothing"


def test_two_hosts_with_one_certificate(site: TunnelSite, kit: Path) -> None:
    with site.joined(kit) as owner:
        mark = site.mark
        thief = site.join(kit, site.attacker)
        with thief:
            site.trail.wait_for(_up_from(ATTACKER), since=mark)
            mark = site.mark
            # The owner's host starts its tunnel again, as any host does that has lost it.
            site.trail.wait_for(_up_from(OCU), since=mark)
            assert len([row for row in site.hosts() if row["address"] == owner.address]) == 1
        assert thief.address == owner.address
        mark = site.mark
        if site.state() != "up":
            site.trail.wait_for(_up_from(OCU), since=mark)


def _up_from(remote: str) -> Callable[[Event], bool]:
    return lambda event: event.get("event") == "tunnel up" and event["detail"]["remote"] == remote


def test_an_expired_certificate_ends_its_tunnel(site: TunnelSite, other: Host) -> None:
    mark, seconds = site.mark, allowed(20)
    expiring = site.kit("add", "visitor", "--for", f"{seconds:g}s")
    with site.join(expiring, other) as visitor:
        site.recorded(mark, event="tunnel up", host=visitor.address)
        site.trail.wait_for(event="tunnel down", host=visitor.address, since=mark, timeout=seconds + LIMIT)
        refused = site.refused(mark, OTHER)
        assert refused["decision"] == "deny"
    assert site.state("visitor") == "expired"
    site.appliance.rosrv("host", "revoke", "visitor")


def charon_of(site: TunnelSite) -> int:
    (parent,) = site.appliance.pids("charon")
    (child,) = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return int(child)


def kilobytes(pid: int) -> int:
    match = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert match is not None
    return int(match[1])


def test_garbage_on_the_ports_of_ike(site: TunnelSite, kit: Path, other: Host, others_kit: Path) -> None:
    with (
        Capture(lab_host(site).namespace) as wire,
        site.joined(kit) as joined,
        site.talking(joined) as (_, ear),
    ):
        first = next(
            frame for frame in wire.frames if frame.ipv4 and frame.ports[1] == 500 and frame.source == OCU
        )
        before, memory = charon_of(site), kilobytes(charon_of(site))
        downs = len(site.trail.seen(event="tunnel down"))
        _throw_garbage(site.attacker)
        _begin_handshakes(site.attacker, first, 5000)
        mark = len(ear.events)
        with site.joined(others_kit, other):
            pass
        ear.wait_for(event="received", since=mark)
        assert charon_of(site) == before
        assert kilobytes(before) - memory < 24 << 10
        lost = [one for one in site.trail.seen(event="tunnel down")[downs:] if one["host"] == joined.address]
        assert lost == [], "the honest host's tunnel was never lost"


def _throw_garbage(host: Host) -> None:
    with host.entered(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thrower:
        for port in (500, 4500):
            for size in [*range(1, 1400, 3), 9000, 30000, 65507, 65507]:
                noise = secrets.token_bytes(size)
                # Raw, and behind an IKEv2 header (an IKE_SA_INIT request) with a length of its own.
                marker = bytes(4) if port == 4500 else b""
                header = os.urandom(8) + bytes(8) + bytes([33, 0x20, 34, 8]) + bytes(4)
                for length in (size + 28, 0, 28, 0xFFFFFFFF):
                    whole = marker + header + length.to_bytes(4) + noise
                    thrower.sendto(whole[:65507], (MIDDLE, port))
                thrower.sendto(noise, (MIDDLE, port))


def _begin_handshakes(host: Host, first: Frame, count: int) -> None:
    start = first.header
    frames = []
    for number in range(count):
        data = bytearray(first.data)
        data[start + 8 : start + 16] = os.urandom(8)
        source = socket.inet_aton(f"10.88.{1 + number // 250 % 250}.{1 + number % 250}")
        packet = udp_packet(
            (socket.inet_ntoa(source), 500), (MIDDLE, 500), bytes(data[start + 8 :])[: len(first.udp_payload)]
        )
        frames.append(bytes(data[:14]) + packet)
    send_frames(host, frames)
