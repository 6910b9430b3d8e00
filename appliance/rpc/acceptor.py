"""Accept connections, from two accept queues of the kernel, by source address.

A flood delays all later connections of its accept queue. So two sockets of one port (`SO_REUSEPORT`) have two queues,
and a BPF program picks the queue by address. Accepting from the second queue waits for the turn of unknown hosts
(`paced`).

The queue affects only the order: every connection is judged by its address afterwards. While the second socket does
not exist (control restarts), the first socket gets all connections.
"""

import array
import asyncio
import errno
import ipaddress
import socket
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import structlog

from appliance.policy.model import Address, address_of, plain_address
from appliance.rpc.processor_time import ProcessorTime

if TYPE_CHECKING:  # the API's process accepts connections too, and does not load the policy's modules
    from appliance.policy.policy import Policy

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
Program = Callable[[], bytes]
"""Returns the BPF program for the policy in force; the same object until the policy changes."""

BACKLOG = 4096
_CLOSING_SECONDS = 15e-6  # the processor time to accept and close a connection
_AT_ONCE = 256  # the most connections in one turn of the event loop
_AT_ONCE_PACED = 32  # the most connections in one paced turn
_UNKNOWN = address_of("0.0.0.0")  # noqa: S104 - stands for all unknown hosts, which are charged as one host
_GONE = frozenset({errno.ECONNABORTED, errno.EINTR, errno.EPROTO})
_PAUSE_SECONDS = 0.2  # the pause after the process ran out of descriptors

FIRST, SECOND = 0, 1  # the sockets of a port, as the kernel numbers them
_MAX_INSTRUCTIONS = 1024  # the most instructions of a program; each listener has a copy

_ATTACH = 51  # SO_ATTACH_REUSEPORT_CBPF
# Classic BPF, as in linux/bpf_common.h and linux/filter.h.
_LOAD, _LOAD_STORED, _STORE, _AND, _JUMP, _JUMP_EQUAL, _RETURN = 0x20, 0x60, 0x02, 0x54, 0x05, 0x15, 0x06
_PROTOCOL = -0x1000  # SKF_AD_OFF + SKF_AD_PROTOCOL
_SOURCE = {4: 12 - 0x100000, 6: 8 - 0x100000}  # the source address, from SKF_NET_OFF
_WORD = 0xFFFFFFFF

_LOOPBACK = (ipaddress.ip_network("127.0.0.0/8"), ipaddress.ip_network("::1"))

_log = structlog.get_logger()


class NamedFirst:
    """Makes a policy's program: this machine and the named hosts use the first queue, blocked hosts the second."""

    def __init__(self, policy: "Callable[[], Policy]") -> None:
        self._policy = policy
        self._of: Policy | None = None
        self._program = b""

    def __call__(self) -> bytes:
        policy = self._policy()
        if policy is not self._of:
            blocked = [address for address in policy.blocks if policy.hosts.narrowest(address) is not None]
            self._of = policy
            self._program = first_for([*_LOOPBACK, *policy.hosts.networks()], blocked)
        return self._program


class SourceQueues:
    """The two queues of a port, between which `program` chooses.

    Raises `OSError` if the kernel does not support such programs.
    """

    def __init__(self, first: socket.socket, program: Program, backlog: int) -> None:
        self._program = program
        self._attached: bytes | None = None
        self._first = first
        first.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        self.second = socket.socket(first.family, socket.SOCK_STREAM)
        try:
            for option in (socket.SO_REUSEADDR, socket.SO_REUSEPORT):
                self.second.setsockopt(socket.SOL_SOCKET, option, 1)
            if first.family == socket.AF_INET6:
                only = first.getsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY)
                self.second.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, only)
            self.second.bind(first.getsockname())
            self.second.listen(backlog)
            self._attach(program())
        except OSError:
            self.second.close()
            raise

    def update(self) -> None:
        program = self._program()
        if program is self._attached:
            return
        try:
            self._attach(program)
        except OSError as error:
            _log.error("connections are sorted by an earlier policy", reason=str(error))
            self._attached = program  # do not try this program again

    def _attach(self, program: bytes) -> None:
        code = array.array("B", program)
        address, size = code.buffer_info()
        self._first.setsockopt(socket.SOL_SOCKET, _ATTACH, struct.pack("HP", size // 8, address))
        self._attached = program


def first_for(networks: Iterable[Network], blocked: Iterable[Address] = ()) -> bytes:
    """Return the program that sends these sources, except blocked ones, to the first socket.

    If there are too many addresses for a program, it ignores the blocks, or sends all sources to the first socket.
    """
    networks = list(networks)
    tests = [(network, FIRST) for network in networks]
    code = _program([*((ipaddress.ip_network(address), SECOND) for address in blocked), *tests])
    if len(code) > _MAX_INSTRUCTIONS:
        code = _program(tests)
    if len(code) > _MAX_INSTRUCTIONS:
        _log.warning("the policy names too many networks to sort connections", networks=len(networks))
        code = [_instruction(_RETURN, FIRST)]
    return b"".join(code)


def _program(tests: Sequence[tuple[Network, int]]) -> list[bytes]:
    """Return a program in which the first network that contains the source decides."""
    code = [_instruction(_LOAD, _PROTOCOL)]
    for version, ethertype in ((4, 0x0800), (6, 0x86DD)):
        own = _tests(version, [test for test in tests if test[0].version == version])
        code += [_instruction(_JUMP_EQUAL, ethertype, 1, 0), _instruction(_JUMP, len(own)), *own]
    code.append(_instruction(_RETURN, SECOND))
    return code


def _tests(version: int, networks: list[tuple[Network, int]]) -> list[bytes]:
    words = 4 if version == 6 else 1
    code = []
    for word in range(words):
        code += [_instruction(_LOAD, _SOURCE[version] + 4 * word), _instruction(_STORE, word)]
    for network, socket_number in networks:
        test = [_instruction(_RETURN, socket_number)]
        for word in reversed(range(words)):
            shift = 32 * (words - 1 - word)
            mask, wanted = (
                int(network.netmask) >> shift & _WORD,
                int(network.network_address) >> shift & _WORD,
            )
            if mask:
                differs = _instruction(_JUMP_EQUAL, wanted, 0, len(test))
                test = [_instruction(_LOAD_STORED, word), _instruction(_AND, mask), differs, *test]
        code += test
    return [*code, _instruction(_RETURN, SECOND)]


def _instruction(operation: int, operand: int, if_true: int = 0, if_false: int = 0) -> bytes:
    return struct.pack("HBBI", operation, if_true, if_false, operand & _WORD)


class Acceptor:
    """Accepts connections; `accepted` owns the socket, and the host is charged for the time.

    If `accepted` returns False (too many connections), its host's other connections in the same turn are closed.
    """

    def __init__(
        self,
        sock: socket.socket,
        time: ProcessorTime,
        accepted: Callable[[socket.socket, Address], bool],
        *,
        paced: bool = False,
    ) -> None:
        self._sock = sock
        self._time = time
        self._accepted = accepted
        self._at_once = _AT_ONCE_PACED if paced else _AT_ONCE
        self._pause: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self._readable = self._accept_in_turn if paced else self._accept
        sock.setblocking(False)
        sock.listen(BACKLOG)
        self._loop.add_reader(sock, self._readable)

    def close(self) -> None:
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._sock)
        self._sock.close()

    def _accept_in_turn(self) -> None:
        if not self._time.run(_UNKNOWN, self._accept_paced):
            self._loop.remove_reader(self._sock)

    def _accept_paced(self) -> None:
        if self._sock.fileno() >= 0:  # False if the socket was closed before its turn
            self._loop.add_reader(self._sock, self._readable)
            self._accept()

    def _accept(self) -> None:
        closed: Counter[str] = Counter()
        try:
            for _ in range(self._at_once):
                sock, address = self._sock.accept()
                text = address[0]
                if text in closed:
                    sock.close()
                    closed[text] += 1
                elif not self._hand_over(sock, text):
                    closed[text] = 0
        except BlockingIOError:
            pass
        except OSError as error:
            if error.errno not in _GONE:
                self._wait(error)
        for text, count in closed.items():
            self._time.charge(plain_address(text), count * _CLOSING_SECONDS)

    def _hand_over(self, sock: socket.socket, text: str) -> bool:
        host = plain_address(text)
        outermost = self._time.begin()
        try:
            return self._accepted(sock, host)
        finally:
            if outermost:
                self._time.end(host)

    def _wait(self, error: OSError) -> None:
        _log.error("no connection can be accepted", reason=str(error))
        self._loop.remove_reader(self._sock)
        self._pause = self._loop.call_later(_PAUSE_SECONDS, self._loop.add_reader, self._sock, self._readable)
