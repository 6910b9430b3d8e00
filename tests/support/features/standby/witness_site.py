import contextlib
import json
import os
import resource
import socket
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.features.standby.lease import Operation, WitnessAnswer, WitnessRequest
from appliance.features.standby.process import WitnessChannel
from appliance.features.standby.witness.lease_file import LeaseFile
from appliance.features.standby.witness.one_file import witness_program
from examples.landshark.lab import Host, Lab
from tests.support.processes import LIMIT, Process
from tests.support.requirements import need_program
from tests.support.waiting import eventually

ROBOT, FIXED = "10.77.0.10", "10.77.0.100"
ADDRESSES = {"a": "10.77.0.2", "b": "10.77.0.3"}
KEYS = {"a": b"\xaa" * 32, "b": b"\xbb" * 32}
FOLLOWER, FOLLOWER_KEY = "10.77.0.20", b"\xff" * 32
MASTER, NODE, WITNESS = 11311, 40000, 7411
THE_PROGRAM = 'exec "$(readlink "$0.real" || echo /usr/sbin/nft)" "$@"'
"""The end of a script that goes on as the program whose place it has."""

AT_ONCE = LIMIT  # seconds; a hanging connection would last for hours
BACKENDS = ("nft", "iptables-nft", "iptables-legacy")


class Peer:
    def __init__(self, host: Host, name: str, key: bytes) -> None:
        self.name = name
        self.channel = WitnessChannel(name, key, os.urandom(8).hex())
        self.socket = host.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self.socket.connect((ROBOT, WITNESS))
        self.socket.settimeout(0.2)
        self.sent = b""

    def ask(self, operation: Operation, epoch: int) -> WitnessAnswer:
        """Repeat a request until it is answered, and ignore late answers to earlier requests."""
        asked: list[WitnessRequest] = []

        def is_of_this(request: WitnessRequest) -> bool:
            """Accept the answer to an earlier claim of this epoch, because that claim may have been granted.

            Each epoch is claimed once.
            """
            claimed = (request.operation, request.epoch) == ("claim", epoch)
            return any(request is one for one in asked) or (operation == "claim" and claimed)

        def answer() -> WitnessAnswer | None:
            asked.append(WitnessRequest(operation, epoch, 1, 0.0))
            self.sent = self.channel.write(asked[-1])
            with contextlib.suppress(OSError):
                self.socket.send(self.sent)
                found = self.channel.read(self.socket.recv(1024))
                return found[1] if found and is_of_this(found[0]) else None
            return None

        return eventually(answer, "the witness answers")

    def granted(self, epoch: int) -> int:
        def grant() -> int | None:
            answer = self.ask("claim", epoch)
            return answer.epoch if answer.ok else None

        return eventually(grant, f"{self.name} gets the lease")


class Site:
    def __init__(self, lab: Lab, folder: Path, backend: str, sockets: contextlib.ExitStack) -> None:
        self.lab, self.sockets = lab, sockets
        self.robot = lab.host("robot", f"{ROBOT}/24")
        self.hosts = {name: lab.host(name, f"{address}/24") for name, address in ADDRESSES.items()}
        self.attacker = lab.host("attacker", "10.77.0.66/24")
        self.follower = lab.host("follower", f"{FOLLOWER}/24")
        self.folder = folder
        self.backend = "nft" if backend == "nft" else "iptables"
        programs = folder / "programs"
        programs.mkdir()
        if self.backend == "iptables":
            for tool in ("restore", "save"):
                path = need_program(f"{backend}-{tool}", "iptables")
                (programs / f"iptables-{tool}").symlink_to(path)
        self.environment = {"PATH": f"{programs}:{os.environ['PATH']}:/usr/sbin"}
        self.programs = programs
        self.settings = folder / "witness.json"
        appliances = {
            name: {"address": address, "key": KEYS[name].hex()} for name, address in ADDRESSES.items()
        }
        common: dict[str, object] = {
            "listen": f"{ROBOT}:{WITNESS}",
            "fixed": FIXED,
            "ports": [str(MASTER), "20000-20999"],
            "followers": {"arm": {"address": FOLLOWER, "key": FOLLOWER_KEY.hex()}},
        }
        own: dict[str, object] = {"appliances": appliances, "state": str(folder / "lease")}
        write_settings(self.settings, common | own)
        self.follower_settings = folder / "follower.json"
        own = {"appliances": {name: {"address": address} for name, address in ADDRESSES.items()}}
        own |= {"follows_as": "arm", "state": str(folder / "epoch")}
        write_settings(self.follower_settings, common | own)
        (folder / "witness.py").write_text(witness_program())
        self.lease = LeaseFile(str(folder / "lease"), ("a", "b"))
        self.servers = {name: self._listening(host, MASTER) for name, host in self.hosts.items()}
        self.node = self._listening(self.robot, NODE)
        self.process: Process | None = None
        self.following: Process | None = None

    def command(self, *words: str, settings: Path | None = None) -> list[str]:
        program = str(self.folder / "witness.py")
        options = ["--settings", str(settings or self.settings), "--backend", self.backend]
        return [sys.executable, "-I", "-S", program, *words, *options]

    def run(self, *words: str) -> None:
        with Process(self.robot, self.command(*words), env=self.environment, label=words[0]) as process:
            process.wait()
            assert process.popen.returncode == 0, process.errors

    @contextlib.contextmanager
    def firewall_program(self, script: str) -> Iterator[None]:
        """Put a script into the place of the programs of the firewall."""
        names = ["nft"] if self.backend == "nft" else ["iptables-save", "iptables-restore"]
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                (self.programs / name).rename(self.programs / f"{name}.real")
            (self.programs / f"{name}.new").write_text(f"#!/bin/sh\n{script}\n")
            (self.programs / f"{name}.new").chmod(0o755)
            (self.programs / f"{name}.new").rename(self.programs / name)
        try:
            yield
        finally:
            for name in names:
                (self.programs / name).unlink()
                with contextlib.suppress(FileNotFoundError):
                    (self.programs / f"{name}.real").rename(self.programs / name)

    def serve(self) -> Process:
        self.process = Process(self.robot, self.command("serve"), env=self.environment, label="witness")
        eventually(lambda: "answers at" in self.log(), self.log)
        return self.process

    def follow(self) -> Process:
        command = self.command("follow", settings=self.follower_settings)
        following = Process(self.follower, command, env=self.environment, label="follower")
        self.following = following
        eventually(
            lambda: "follows the witness" in "\n".join(following.errors), lambda: str(following.errors)
        )
        return following

    def log(self) -> str:
        return "\n".join(self.process.errors) if self.process is not None else ""

    def stop(self) -> None:
        for process in (self.process, self.following):
            if process is not None:
                process.stop()

    def peer(self, name: str) -> Peer:
        peer = Peer(self.hosts[name], name, KEYS[name])
        self.sockets.enter_context(peer.socket)
        return peer

    def connect(self, host: Host, address: str, port: int, seconds: float = LIMIT) -> socket.socket:
        made = host.run(lambda: socket.create_connection((address, port), timeout=seconds))
        return self.sockets.enter_context(made)

    def connecting(self, address: str) -> socket.socket:
        made = self.sockets.enter_context(self.robot.run(socket.socket))
        made.setblocking(False)
        made.connect_ex((address, MASTER))
        return made

    def accepted(self, server: socket.socket) -> socket.socket:
        return self.sockets.enter_context(server.accept()[0])

    def _listening(self, host: Host, port: int) -> socket.socket:
        return self.sockets.enter_context(host.run(lambda: socket.create_server((host.address, port))))

    def refused(self, host: Host, address: str, port: int) -> bool:
        begun = time.monotonic()
        try:
            self.connect(host, address, port, LIMIT / 3).close()
        except ConnectionRefusedError:
            return time.monotonic() - begun < AT_ONCE
        except TimeoutError:
            pass
        return False


@contextlib.contextmanager
def broken_disk(process: Process) -> Iterator[None]:
    """Let each write of a process to a file fail."""
    pid = process.popen.pid
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        if process.popen.poll() is None:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, before)


def write_settings(path: Path, settings: dict[str, object]) -> None:
    path.write_text(json.dumps(settings))
    path.chmod(0o600)


def forged(source: str, payload: bytes) -> bytes:
    udp = struct.pack("!HHHH", 5555, WITNESS, 8 + len(payload), 0) + payload
    ends = socket.inet_aton(source) + socket.inet_aton(ROBOT)
    return struct.pack("!BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, socket.IPPROTO_UDP, 0) + ends + udp


def seconds_until_reset(connections: list[socket.socket]) -> float:
    begun = time.monotonic()
    for connection in connections:
        connection.settimeout(LIMIT)
        with pytest.raises(ConnectionResetError):
            connection.recv(1)
    return time.monotonic() - begun
