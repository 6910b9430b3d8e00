"""The witness with the kernel's firewall and real connections: a robot, two appliances, an attacker on one network."""

import asyncio
import contextlib
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.standby import witness
from appliance.standby.lease import Operation, WitnessAnswer, WitnessRequest
from appliance.standby.witness import LeaseFile
from appliance.standby.witness_link import WitnessChannel, WitnessLink
from examples.landshark.lab import Host, Lab
from tests.support.processes import LIMIT, Process
from tests.support.requirements import need_program, need_root
from tests.support.waiting import eventually

ROBOT, FIXED = "10.77.0.10", "10.77.0.100"
ADDRESSES = {"a": "10.77.0.2", "b": "10.77.0.3"}
KEYS = {"a": b"\xaa" * 32, "b": b"\xbb" * 32}
MASTER, NODE, WITNESS = 11311, 40000, 7411
AT_ONCE = LIMIT  # seconds; a hanging connection would last for hours
BACKENDS = ("nft", "iptables-nft", "iptables-legacy")


class Peer:
    """An appliance that asks the witness."""

    def __init__(self, host: Host, name: str) -> None:
        self.name = name
        self.channel = WitnessChannel(name, KEYS[name], os.urandom(8).hex())
        self.socket = host.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self.socket.connect((ROBOT, WITNESS))
        self.socket.settimeout(0.2)
        self.sent = b""

    def ask(self, operation: Operation, epoch: int) -> WitnessAnswer:
        """Return the witness's answer; a lost one is asked for again."""

        def answer() -> WitnessAnswer | None:
            self.sent = self.channel.write(WitnessRequest(operation, epoch, 1, 0.0))
            with contextlib.suppress(OSError):
                self.socket.send(self.sent)
                found = self.channel.read(self.socket.recv(1024))
                return None if found is None else found[1]
            return None

        return eventually(answer, "the witness answers")

    def granted(self, epoch: int) -> int:
        """Claim until the claim is granted; return the epoch."""

        def grant() -> int | None:
            answer = self.ask("claim", epoch)
            return answer.epoch if answer.ok else None

        return eventually(grant, f"{self.name} gets the lease")


class Site:
    """The machines, the witness's files, and its process."""

    def __init__(self, lab: Lab, folder: Path, backend: str, sockets: contextlib.ExitStack) -> None:
        self.sockets = sockets
        self.robot = lab.host("robot", f"{ROBOT}/24")
        self.hosts = {name: lab.host(name, f"{address}/24") for name, address in ADDRESSES.items()}
        self.attacker = lab.host("attacker", "10.77.0.66/24")
        self.folder = folder
        self.backend = "nft" if backend == "nft" else "iptables"
        programs = folder / "programs"
        programs.mkdir()
        if self.backend == "iptables":
            for tool in ("restore", "save"):
                path = need_program(f"{backend}-{tool}", "iptables")
                (programs / f"iptables-{tool}").symlink_to(path)
        self.environment = {"PATH": f"{programs}:{os.environ['PATH']}:/usr/sbin"}
        self.settings = folder / "witness.json"
        appliances = {
            name: {"address": address, "key": KEYS[name].hex()} for name, address in ADDRESSES.items()
        }
        settings = {
            "listen": f"{ROBOT}:{WITNESS}",
            "fixed": FIXED,
            "ports": [str(MASTER), "20000-20999"],
            "appliances": appliances,
            "state": str(folder / "lease"),
        }
        self.settings.write_text(json.dumps(settings))
        self.settings.chmod(0o600)
        shutil.copy(str(witness.__file__), folder / "witness.py")
        self.lease = LeaseFile(str(folder / "lease"), ("a", "b"))
        self.servers = {name: self._listening(host, MASTER) for name, host in self.hosts.items()}
        self.node = self._listening(self.robot, NODE)
        self.process: Process | None = None

    def command(self, *words: str) -> list[str]:
        """Return a command of the witness's program, as on a robot without the product."""
        program = str(self.folder / "witness.py")
        options = ["--settings", str(self.settings), "--backend", self.backend]
        return [sys.executable, "-I", "-S", program, *words, *options]

    def run(self, *words: str) -> None:
        """Run a command on the robot to its end."""
        with Process(self.robot, self.command(*words), env=self.environment, label=words[0]) as process:
            process.wait()
            assert process.popen.returncode == 0, process.errors

    def serve(self) -> Process:
        """Start the witness."""
        self.process = Process(self.robot, self.command("serve"), env=self.environment, label="witness")
        eventually(lambda: "answers at" in self.log(), self.log)
        return self.process

    def log(self) -> str:
        """Return the witness's log."""
        return "\n".join(self.process.errors) if self.process is not None else ""

    def peer(self, name: str) -> Peer:
        """Return an appliance."""
        peer = Peer(self.hosts[name], name)
        self.sockets.enter_context(peer.socket)
        return peer

    def connect(self, host: Host, address: str, port: int, seconds: float = LIMIT) -> socket.socket:
        """Connect from a host."""
        made = host.run(lambda: socket.create_connection((address, port), timeout=seconds))
        return self.sockets.enter_context(made)

    def accepted(self, server: socket.socket) -> socket.socket:
        """Return the next connection of a server."""
        return self.sockets.enter_context(server.accept()[0])

    def _listening(self, host: Host, port: int) -> socket.socket:
        return self.sockets.enter_context(host.run(lambda: socket.create_server((host.address, port))))

    def refused(self, host: Host, address: str, port: int) -> bool:
        """Whether a connection is refused at once. While the rules change, an attempt may get no answer."""
        begun = time.monotonic()
        try:
            self.connect(host, address, port, LIMIT / 3).close()
        except ConnectionRefusedError:
            return time.monotonic() - begun < AT_ONCE
        except TimeoutError:
            pass
        return False


@pytest.fixture(params=BACKENDS)
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Site]:
    """Yield a site whose lease has epoch 1, without a running witness."""
    need_root()
    with Lab("rosrv-witness") as lab, contextlib.ExitStack() as sockets:
        made = Site(lab, tmp_path, request.param, sockets)
        made.run("begin", "--in-sync", "a,b", "--epoch", "1")
        yield made
        if made.process is not None:
            made.process.stop()


def seconds_until_reset(connections: list[socket.socket]) -> float:
    """Return the time until all are reset; none of them sends."""
    begun = time.monotonic()
    for connection in connections:
        connection.settimeout(LIMIT)
        with pytest.raises(ConnectionResetError):
            connection.recv(1)
    return time.monotonic() - begun


def test_a_new_holder_resets_the_connections_of_the_old_one(site: Site) -> None:
    """In both directions, also the idle ones; new connections reach the new holder through the same address."""
    site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    to_master = [site.connect(site.robot, FIXED, MASTER) for _ in range(3)]
    accepted = [site.accepted(site.servers["a"]) for _ in to_master]
    from_a = [site.connect(site.hosts["a"], ROBOT, NODE) for _ in range(3)]
    at_node = [site.accepted(site.node) for _ in from_a]
    for near, far in zip(to_master + at_node, accepted + from_a, strict=True):
        near.sendall(b"x")
        assert far.recv(1) == b"x"
    assert site.refused(site.hosts["b"], ROBOT, NODE)
    assert site.refused(site.robot, ADDRESSES["b"], MASTER)

    assert a.ask("release", epoch).ok
    epoch = b.granted(epoch)
    assert seconds_until_reset(to_master + at_node) < AT_ONCE
    with contextlib.suppress(ConnectionResetError):
        for far in accepted + from_a:
            far.send(b"x")
    assert seconds_until_reset(from_a) < AT_ONCE

    new = site.connect(site.robot, FIXED, MASTER)
    far = site.accepted(site.servers["b"])
    new.sendall(b"y")
    assert far.recv(1) == b"y"
    site.connect(site.hosts["b"], ROBOT, NODE).close()
    assert site.refused(site.hosts["a"], ROBOT, NODE)
    assert site.refused(site.robot, ADDRESSES["a"], MASTER)

    assert b.ask("release", epoch).ok
    a.granted(epoch)
    assert seconds_until_reset([new]) < AT_ONCE
    site.connect(site.robot, FIXED, MASTER).close()
    site.accepted(site.servers["a"])


def test_a_reboot_shuts_out_both_until_the_holder_renews(site: Site) -> None:
    """The boot rule needs no witness; the first renewal admits the holder again, and a claim waits."""
    process = site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    process.stop()
    site.connect(site.robot, FIXED, MASTER).close()  # the end of the witness alone changes nothing
    site.run("remove")
    site.lease.write(site.lease.read()._replace(boot="an earlier boot"))
    site.run("shut")
    for name, host in site.hosts.items():
        assert site.refused(host, ROBOT, NODE)
        assert site.refused(site.robot, ADDRESSES[name], MASTER)
    assert site.refused(site.robot, FIXED, MASTER)
    site.serve()
    assert "holds the lease for another" in b.ask("claim", epoch).reason
    assert site.refused(site.hosts["a"], ROBOT, NODE)
    assert a.ask("renew", epoch).ok
    site.connect(site.robot, FIXED, MASTER).close()
    assert site.refused(site.hosts["b"], ROBOT, NODE)


def test_a_damaged_lease_shuts_out_both_until_begin(site: Site) -> None:
    """The log and the answers have the command."""
    (site.folder / "lease").write_bytes(b"damaged")
    process = site.serve()
    assert "witness.py begin" in site.log()
    a = site.peer("a")
    assert "run witness.py begin" in a.ask("claim", 1).reason
    assert site.refused(site.hosts["a"], ROBOT, NODE)
    process.stop()
    site.run("begin", "--in-sync", "a", "--epoch", "7")
    site.serve()
    assert a.granted(7) == 8
    site.connect(site.hosts["a"], ROBOT, NODE).close()


def test_rules_that_another_program_removes_are_written_again(site: Site) -> None:
    """Whether they were removed, or rules for established connections were put before them."""
    site.serve()
    site.peer("a").granted(1)
    if site.backend == "nft":
        changes = [(["nft", "flush", "ruleset"], "")]
    else:
        accept = "*filter\n-I INPUT 1 -j ACCEPT\nCOMMIT\n"
        changes = [(["iptables-restore", "--noflush"], accept), (["iptables-restore"], "*filter\nCOMMIT\n")]
    for command, text in changes:
        assert site.refused(site.hosts["b"], ROBOT, NODE)
        with Process(site.robot, command, env=site.environment, label=command[0]) as process:
            assert process.popen.stdin is not None
            process.popen.stdin.write(text)
            process.popen.stdin.close()
            process.wait()
        eventually(lambda: site.refused(site.hosts["b"], ROBOT, NODE), "b is shut out again")
    assert "another program changed the firewall rules" in site.log()
    site.connect(site.robot, FIXED, MASTER).close()


def forged(source: str, payload: bytes) -> bytes:
    """Return an IPv4 packet with a UDP datagram to the witness, from any address."""
    udp = struct.pack("!HHHH", 5555, WITNESS, 8 + len(payload), 0) + payload
    ends = socket.inet_aton(source) + socket.inet_aton(ROBOT)
    return struct.pack("!BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, socket.IPPROTO_UDP, 0) + ends + udp


def test_an_attacker_on_the_network_gets_no_lease_and_delays_none(site: Site) -> None:
    """Forged, recorded and many datagrams, under the appliance's own address: nothing changes, renewals continue."""
    site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    assert a.ask("renew", epoch).ok
    recorded = [a.sent]
    assert a.ask("remove", epoch).ok
    assert a.ask("add", epoch).ok
    recorded.append(a.sent)
    assert a.ask("remove", epoch).ok
    raw = site.attacker.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW))
    site.sockets.enter_context(raw)
    wrong_key = WitnessChannel("b", KEYS["a"], "session").write(WitnessRequest("claim", epoch, 1, 0.0))
    for number in range(8_000):
        payload = (recorded[0], recorded[1], wrong_key, os.urandom(100))[number % 4]
        source = (ADDRESSES["a"], ADDRESSES["a"], ADDRESSES["b"], "10.77.0.66")[number % 4]
        raw.sendto(forged(source, payload), (ROBOT, 0))
        if number % 800 == 0:
            assert a.ask("renew", epoch).ok
    assert a.ask("renew", epoch).ok
    assert site.lease.read().in_sync == ("a",)
    assert not b.ask("claim", epoch).ok
    eventually(lambda: "without a valid authentication code" in site.log(), site.log)
    assert len(site.log().splitlines()) < 40
    site.connect(site.robot, FIXED, MASTER).close()


def test_the_appliances_socket_gets_the_lease(site: Site) -> None:
    """The asyncio socket of an appliance, with lost first answers."""
    site.serve()

    async def claimed() -> WitnessAnswer:
        answers: asyncio.Queue[WitnessAnswer] = asyncio.Queue()
        link = WitnessLink(
            WitnessChannel("a", KEYS["a"], "session"), lambda _, answer: answers.put_nowait(answer)
        )
        with site.hosts["a"].entered():
            own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        own.setblocking(False)
        own.connect((ROBOT, WITNESS))
        link.send(WitnessRequest("claim", 1, 1, 0.0))  # before there is a socket: lost
        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(lambda: link, sock=own)
        with contextlib.closing(transport):
            async with asyncio.timeout(LIMIT):
                while True:
                    link.send(WitnessRequest("claim", 1, 2, 0.0))
                    with contextlib.suppress(TimeoutError):
                        answer = await asyncio.wait_for(answers.get(), 0.3)
                        if answer.ok:
                            return answer

    assert asyncio.run(claimed()).holder == "a"


def test_the_units_start_the_witness_and_shut_out_both_before_the_network() -> None:
    """systemd accepts both files; their commands are those of the program."""
    folder = Path(witness.__file__).parent
    units = sorted(folder.glob("*.service"))
    command = [need_program("systemd-analyze", "systemd"), "verify", *map(str, units)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    shutting, serving = (unit.read_text() for unit in units)
    assert "ExecStart=/usr/bin/python3 -I /etc/rosrv/witness.py serve\n" in serving
    assert "ExecStart=/usr/bin/python3 -I /etc/rosrv/witness.py shut\n" in shutting
    assert "Before=network-pre.target" in shutting and "DefaultDependencies=no" in shutting
