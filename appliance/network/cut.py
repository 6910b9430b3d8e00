"""End TCP connections of a network namespace, and refuse new ones to their ports for a minute.

Connections that already exist outlive any rule, so a change of the way must end them, as if the process at this end
had closed them. A reset would do harm: a rospy node with a persistent service gets an error that it does not expect,
and roscpp looks a service up without a second try. So the socket is shut down by a copy of the process's descriptor.
Only where that is not possible the kernel destroys it (`SOCK_DESTROY`), and the peer gets a reset.

Only ports whose connections were ended are refused, and with a reset:

1. After a reset rospy 1.15 and later gives up the direct connection; after a timeout it would repeat it for ever.
2. A refusal of all direct connections would also hit other programs: roslaunch waits for its own server
   for ever.
3. The tables belong to this module alone. Elements of the first expire in the kernel, even if the appliance dies.
"""

import contextlib
import ctypes
import errno
import functools
import ipaddress
import os
import socket
import struct
import threading
from collections.abc import Callable, Collection, Iterable
from functools import partial
from typing import NamedTuple

from appliance.network.hang_detection import run_program
from appliance.network.listening_sockets import TcpSocket, tcp_inodes, tcp_sockets
from appliance.network.machine_addresses import machine_addresses
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.socket_owners import NodeSockets, SocketOwner, is_node, owners_of

REFUSED_SECONDS = 60
_TABLE, _CLOSED = "inet rosrv-cut", "inet rosrv-closed"
_PIDFD_GETFD = 438  # the number of the system call on every architecture
_NETLINK_SOCK_DIAG, _SOCK_DIAG_BY_FAMILY, _SOCK_DESTROY, _NLMSG_ERROR = 4, 20, 21, 2
_REQUEST, _REQUEST_ACK = 0x1, 0x5  # NLM_F_REQUEST; with NLM_F_ACK
_ANY_STATE, _NO_COOKIE, _OF_NO_SOCKET = 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF, 0
_HEAD = struct.Struct("=IHHII")  # struct nlmsghdr
_ERROR = struct.Struct("=i")
_FOUND = struct.Struct("=xB42xQ")  # struct inet_diag_msg: the state and the cookie
_ENDED_STATES = (6, 7, 10)  # TIME_WAIT, CLOSE, and LISTEN, which is the port's listener
_SECONDS = 2.0
NO_INODE = "0"
"""The inode of a connection that its process has not accepted yet."""

_GONE = (errno.ENOENT, errno.ECONNREFUSED, errno.ESTALE)  # it ended before its removal


class RemotePort(NamedTuple):
    """A TCP port of another machine, by IPv4 address."""

    address: str
    port: int


def end_connections(
    namespace: Namespace, wanted: Callable[[TcpSocket], bool], *, lasting: float = 0.0
) -> int:
    """End the connections that `wanted` selects, also half-open ones; return their number. Raises `NetworkError`.

    A connection that its ends close within `lasting` seconds is left alone, so that a call under way gets its answer.
    """
    try:
        return namespace.run(lambda: _end(wanted, lasting))
    except OSError as error:
        if error.errno == errno.EOPNOTSUPP:
            raise NetworkError(
                "this kernel cannot end connections: it lacks CONFIG_INET_DIAG_DESTROY"
            ) from None
        raise NetworkError(f"ending connections: {error.strerror or error}") from error


def can_end_connections(namespace: Namespace) -> bool:
    """Return whether the kernel can destroy sockets; the attempt is for a connection that does not exist."""
    nothing = TcpSocket(4, "127.0.0.1", 1, "127.0.0.1", 1, listens=False, established=True, inode="0")

    def attempt() -> bool:
        with _diagnosis() as diag:
            return bool(_diagnose(diag, _SOCK_DESTROY, nothing, 1, _OF_NO_SOCKET)[1])

    try:
        return namespace.run(attempt)
    except OSError:
        return False


def refuse_ports(
    namespace: Namespace, link: str, ports: Iterable[int], remote: Iterable[RemotePort] = ()
) -> None:
    """Refuse new connections to these ports of the namespace, and to `remote`, unless they come from `link`."""
    here, there = sorted(set(ports)), sorted(set(remote))
    lines = [
        f"add table {_TABLE}",
        f"add set {_TABLE} cut {{ type inet_service; flags timeout; timeout {REFUSED_SECONDS}s; }}",
        f"add set {_TABLE} cut-there {{ type ipv4_addr . inet_service; flags timeout; timeout {REFUSED_SECONDS}s; }}",
        f"add chain {_TABLE} in {{ type filter hook input priority 0; policy accept; }}",
        f"add chain {_TABLE} out {{ type filter hook output priority 0; policy accept; }}",
        f"flush chain {_TABLE} in",
        f"flush chain {_TABLE} out",
        f'add rule {_TABLE} in iifname != "{link}" tcp dport @cut tcp flags & (syn | ack) == syn counter'
        " reject with tcp reset",
        f"add rule {_TABLE} out ip daddr . tcp dport @cut-there tcp flags & (syn | ack) == syn counter"
        " reject with tcp reset",
    ]
    if here:
        lines.append(f"add element {_TABLE} cut {{ {', '.join(map(str, here))} }}")
    if there:
        pairs = ", ".join(f"{ipaddress.IPv4Address(one.address)} . {one.port}" for one in there)
        lines.append(f"add element {_TABLE} cut-there {{ {pairs} }}")
    run_nft(namespace, "\n".join(lines) + "\n")


def refuse_no_port(namespace: Namespace) -> None:
    run_nft(namespace, f"add table {_TABLE}\ndelete table {_TABLE}\n")


class DisturbedConnections:
    """The connections of a machine that a removal of its rules has disturbed: those that began without the rules, and
    those that the translation no longer carried.

    Sockets have no time, so connections are compared with those of the last look but one: the last may have come after
    the removal. A connection of a node that began since then is ended with them, and its node connects again.
    """

    def __init__(self, machine: Namespace, inside: Namespace, link: str) -> None:
        self._machine, self._inside, self._link = machine, inside, link
        self._before = self._last = frozenset[str]()

    def remember(self) -> None:
        self._before, self._last = self._last, self._machine.run(tcp_inodes) - {NO_INODE}

    def end(
        self, forwarded: Collection[int], master: int | None, near: Collection[str], nodes: Collection[str]
    ) -> int:
        """End these; return the number of connections that began. Raises `NetworkError`.

        1. Between nodes and other machines, if they began since. `nodes` has keys of nodes (`is_node`).
        2. From other machines to a program of this one on a `forwarded` port.
        3. To the robot's own `master`: its callers, also of this machine, shall find RVMaster.
        4. From this machine to the appliance (`near`), if the appliance has lost its end: a rospy subscriber would wait
           for ever.
        """
        sockets, own = self._machine.run(tcp_sockets), {*self._machine.run(machine_addresses), *near}
        listening = {one.port for one in sockets if one.listens}
        inside = {(one.port, one.peer_port) for one in self._inside.run(tcp_sockets)}

        def is_foreign(one: TcpSocket) -> bool:
            peer = one.peer_address
            return not (peer in own or peer == one.local_address or ipaddress.ip_address(peer).is_loopback)

        alive = [one for one in sockets if one.established or one.half_open]
        foreign = {one for one in alive if is_foreign(one)}
        begun = _of_nodes([one for one in foreign if one.inode not in self._before], sockets, nodes)
        reached = {
            one for one in alive if one.port in listening
            and (one.peer_address not in near if one.port == master else one.port in forwarded and one in foreign)
        }  # fmt: skip
        lost = {
            one for one in alive if one not in foreign and one.port not in listening
            and one.peer_port in {*forwarded, master} and (one.peer_port, one.port) not in inside
        }  # fmt: skip
        callees = {
            RemotePort(one.peer_address, one.peer_port) for one in begun
            if one.port not in listening and ipaddress.ip_address(one.peer_address).version == 4
        }  # fmt: skip
        if callees:  # rospy would connect again
            refuse_ports(self._machine, self._link, (), callees)
        chosen = {one[:5]: one in foreign for one in {*begun, *reached, *lost}}
        end_connections(self._machine, lambda one: one[:5] in chosen)
        return sum(chosen.values())


def _of_nodes(
    connections: Collection[TcpSocket], sockets: Iterable[TcpSocket], known: Collection[str]
) -> list[TcpSocket]:
    """Return those of processes that look like nodes and listen on a port, as every node does.

    A half-open one belongs to no process yet; it is returned if its port is a node's.
    """
    if not connections:
        return []
    listeners = [one for one in sockets if one.listens]
    owners = owners_of(one.inode for one in (*connections, *listeners))
    ports = {listener.port: owners[listener.inode].pid for listener in listeners if listener.inode in owners}

    def pid(tcp_socket: TcpSocket) -> int:
        owner = owners.get(tcp_socket.inode)
        return ports.get(tcp_socket.port, 0) if owner is None else owner.pid

    found = {pid(connection) for connection in connections}.intersection(ports.values())
    nodes = {one for one in found if is_node(NodeSockets(one, frozenset(), ""), known)}
    return [connection for connection in connections if pid(connection) in nodes]


def close_port(namespace: Namespace, link: str, port: int) -> None:
    """Refuse new connections to a port of the namespace until `open_port`, unless they come from `link`."""
    lines = [
        f"add table {_CLOSED}",
        f"delete table {_CLOSED}",
        f"add table {_CLOSED}",
        f"add chain {_CLOSED} in {{ type filter hook input priority 0; policy accept; }}",
        f'add rule {_CLOSED} in iifname != "{link}" tcp dport {port} tcp flags & (syn | ack) == syn counter'
        " reject with tcp reset",
    ]
    run_nft(namespace, "\n".join(lines) + "\n")


def open_port(namespace: Namespace) -> None:
    run_nft(namespace, f"add table {_CLOSED}\ndelete table {_CLOSED}\n")


def run_nft(namespace: Namespace, text: str) -> None:
    """Run commands of nft in one transaction. Raises `NetworkError`."""
    try:
        status, out, err = run_program(partial(namespace.popen, ["nft", "-f", "-"]), text, "nft")
    except (OSError, TimeoutError) as error:
        raise NetworkError(f"nft cannot be run: {error}") from None
    if status != 0:
        raise NetworkError(f"nft rejected rules in {namespace.name}: {' '.join((err or out).split())[:300]}")


def _end(wanted: Callable[[TcpSocket], bool], lasting: float) -> int:
    chosen = [one for one in tcp_sockets() if (one.established or one.half_open) and wanted(one)]
    if chosen and lasting:
        threading.Event().wait(lasting)
        still = {one[:5] for one in tcp_sockets() if one.established or one.half_open}
        chosen = [one for one in chosen if one[:5] in still]
    owners = owners_of(one.inode for one in chosen)
    left = [one for one in chosen if not _shut_down(one, owners.get(one.inode))]
    if not left:
        return len(chosen)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _NETLINK_SOCK_DIAG) as diag:
        diag.settimeout(_SECONDS)
        destroyed = sum(_destroy(diag, one, number) for number, one in enumerate(left, 1))
    return len(chosen) - len(left) + destroyed


def _diagnosis() -> socket.socket:
    diag = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _NETLINK_SOCK_DIAG)
    diag.settimeout(_SECONDS)
    return diag


def _shut_down(one: TcpSocket, owner: SocketOwner | None) -> bool:
    """Shut a socket down by a copy of its process's descriptor; return whether that was possible."""
    if owner is None:
        return False
    with contextlib.suppress(OSError):
        process = os.pidfd_open(owner.pid)
        try:
            copy = _copy(process, owner.descriptor)
        finally:
            os.close(process)
        with socket.socket(fileno=copy) as taken:
            if str(os.fstat(taken.fileno()).st_ino) == one.inode:  # the process may have closed it since
                taken.shutdown(socket.SHUT_RDWR)
                return True
    return False


def _copy(process: int, descriptor: int) -> int:
    copy = int(_libc().syscall(_PIDFD_GETFD, process, descriptor, 0))
    if copy < 0:
        raise OSError(ctypes.get_errno(), "pidfd_getfd")
    return copy


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _destroy(diag: socket.socket, tcp_socket: TcpSocket, number: int) -> bool:
    """Destroy a connection; return whether it still existed.

    For a connection that has ended the kernel finds the listener of its port, and would destroy that. So the cookie of
    the connection itself comes first.
    """
    answer, _ = _diagnose(diag, _SOCK_DIAG_BY_FAMILY, tcp_socket, number, _NO_COOKIE)
    if answer is None:
        return False
    state, cookie = _FOUND.unpack_from(answer)
    if state in _ENDED_STATES:
        return False
    _, code = _diagnose(diag, _SOCK_DESTROY, tcp_socket, number, cookie)
    return not code


def _diagnose(
    diag: socket.socket, kind: int, one: TcpSocket, number: int, cookie: int
) -> tuple[bytes | None, int]:
    """Return what the kernel tells of a connection, and the error if it is gone. Raises `OSError` for others."""
    family = socket.AF_INET6 if one.version == 6 else socket.AF_INET
    source, target = (socket.inet_pton(family, text).ljust(16, b"\0") for text in (one.address, one.peer))
    body = struct.pack(
        "=BBBBI", family, socket.IPPROTO_TCP, 0, 0, _ANY_STATE
    ) + struct.pack(">HH", one.port, one.peer_port) + source + target + struct.pack("=IQ", 0, cookie)  # fmt: skip
    flags = _REQUEST if kind == _SOCK_DIAG_BY_FAMILY else _REQUEST_ACK
    diag.send(_HEAD.pack(_HEAD.size + len(body), kind, flags, number, 0) + body)
    while True:
        answer = diag.recv(8192)
        _length, told, _flags, sequence, _process = _HEAD.unpack_from(answer)
        if sequence != number:
            continue
        if told != _NLMSG_ERROR:
            return answer[_HEAD.size :], 0
        code = -_ERROR.unpack_from(answer, _HEAD.size)[0]
        if code and code not in _GONE:
            raise OSError(code, os.strerror(code))
        return None, code
