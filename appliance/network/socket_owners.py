"""Find the process behind each socket of a node. Only root sees the sockets of all processes."""

import pwd
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from appliance.network.listening_sockets import TcpSocket, tcp_sockets
from appliance.network.namespaces import Namespace

_LONGEST_LINE = 80  # bytes of a command line that a message shows


class SocketOwner(NamedTuple):
    """A process, and its descriptor of a socket."""

    pid: int
    descriptor: int


class NodeSockets(NamedTuple):
    """The sockets of the process that listens on a node's port."""

    pid: int
    listening: frozenset[int]
    master_address: str
    """The local address of its connection to a master's port; empty without a connection."""


def node_sockets(namespace: Namespace, ports: Iterable[int], master_port: int) -> dict[int, NodeSockets]:
    """Return the sockets of the processes that listen on `ports`, by port. A process that has ended is left out."""
    wanted = set(ports)
    relevant = [one for one in namespace.run(tcp_sockets) if one.listens or _calls(one, master_port)]
    owners = {inode: owner.pid for inode, owner in owners_of(one.inode for one in relevant).items()}
    sockets: dict[int, NodeSockets] = {}
    for one in relevant:
        pid = owners.get(one.inode)
        if pid is None:
            continue
        so_far = sockets.get(pid, NodeSockets(pid, frozenset(), ""))
        if one.listens:
            sockets[pid] = so_far._replace(listening=so_far.listening | {one.port})
        else:
            sockets[pid] = so_far._replace(master_address=one.local_address)
    return {port: socket for socket in sockets.values() for port in sorted(socket.listening & wanted)}


def is_node(process: NodeSockets, known: Collection[str] = ()) -> bool:
    """Return whether a process looks like a ROS node: it is connected to a master, or was started for ROS.

    `known` has the keys of processes that were connected before: once such a connection has ended, rospy opens another
    one only for its next call.
    """
    if process.master_address or process_key(process.pid) in known:
        return True
    place = Path("/proc", str(process.pid))
    with suppress(OSError):
        words = (place / "cmdline").read_bytes().split(b"\0")
        if any(word.startswith((b"__name:=", b"__master:=")) for word in words):
            return True
        settings = (place / "environ").read_bytes().split(b"\0")
        return any(setting.startswith((b"ROS_MASTER_URI=", b"ROS_PACKAGE_PATH=")) for setting in settings)
    return False


def process_key(pid: int) -> str:
    """Return what no other process of this boot has: the number and the start time. Empty if it has ended."""
    try:
        state = Path("/proc", str(pid), "stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return f"{pid}:{state.rpartition(')')[2].split()[19]}"


def program_of(pid: int) -> str:
    """Return the program and first argument of a process, such as a script; empty if it has ended.

    Later arguments may be secret.
    """
    try:
        line = Path("/proc", str(pid), "cmdline").read_bytes()
    except OSError:
        return ""
    return b" ".join(line.split(b"\0")[:2])[:_LONGEST_LINE].decode("utf-8", "replace").strip()


def user_of(pid: int) -> str:
    """Return the name of a process's user, or its number; empty if the process has ended."""
    try:
        uid = Path("/proc", str(pid)).stat().st_uid
    except OSError:
        return ""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def programs_of_unit(unit: str) -> list[str]:
    """Return the command lines of the processes of a unit of the system's own slice."""
    programs = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with suppress(OSError):
                groups = (entry / "cgroup").read_text(encoding="utf-8", errors="replace")
                if any(line.endswith(f":/system.slice/{unit}") for line in groups.splitlines()):
                    programs.append(
                        (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode("utf-8", "replace")
                    )
    return programs


def _calls(socket: TcpSocket, master_port: int) -> bool:
    return socket.established and socket.peer_port == master_port


def owners_of(inodes: Iterable[str]) -> dict[str, SocketOwner]:
    """Return, for each socket, one process that has it open."""
    owners: dict[str, SocketOwner] = {}
    wanted = {f"socket:[{inode}]": inode for inode in inodes}
    for entry in Path("/proc").iterdir() if wanted else ():
        if not entry.name.isdecimal():
            continue
        with suppress(OSError):
            for descriptor in (entry / "fd").iterdir():
                with suppress(OSError):
                    inode = wanted.get(str(descriptor.readlink()))
                    if inode is not None:
                        owners.setdefault(inode, SocketOwner(int(entry.name), int(descriptor.name)))
    return owners
