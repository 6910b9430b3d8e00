import contextlib
import ipaddress
import socket
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.policy.model import address_of
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.acceptor import BACKLOG, FIRST, SECOND, NamedFirst, Network, SourceQueues, first_for
from appliance.rpc.server import listen
from tests.support.classic_bpf import choose

WAIT = 20.0


def networks(*texts: str) -> list[Network]:
    return [ipaddress.ip_network(text) for text in texts]


def _network(version: int, bits: int) -> st.SearchStrategy[Network]:
    def network(number: int, length: int) -> Network:
        return ipaddress.ip_network((number >> (bits - length) << (bits - length), length))

    assert version in (4, 6)
    # All addresses begin alike, so that most comparisons go beyond the first word.
    small = st.integers(0, 2**bits - 1).map(lambda number: number & (0x3 << (bits // 2)) | number & 0x3)
    lengths = st.integers(1 if version == 4 else 33, bits)
    return st.builds(network, small if version == 4 else small.map(lambda number: number | 1 << 120), lengths)


NETWORK = _network(4, 32) | _network(6, 128)


@given(st.lists(NETWORK, max_size=12), st.lists(NETWORK, min_size=1, max_size=12))
def test_the_program_sends_hosts_of_the_networks_to_the_first_socket(
    known: list[Network], others: list[Network]
) -> None:
    program = first_for(known)
    for network in [*known, *others]:
        for source in (network.network_address, network.broadcast_address):
            held = any(source in one for one in known if one.version == source.version)
            assert choose(program, source) == (FIRST if held else SECOND)


def test_more_networks_than_a_program_has_room_for() -> None:
    many = [ipaddress.ip_network(f"10.{number >> 8}.{number & 255}.0/24") for number in range(1000)]
    assert choose(first_for(many[:200]), ipaddress.ip_address("192.0.2.1")) == SECOND
    assert choose(first_for(many), ipaddress.ip_address("192.0.2.1")) == FIRST


class Port:
    def __init__(self, host: str, *known: str) -> None:
        self.program = first_for(networks(*known))
        self.first = listen(host, 0)
        self.first.settimeout(WAIT)
        self.queues = SourceQueues(self.first, lambda: self.program, BACKLOG)
        self.queues.second.settimeout(WAIT)

    def accepts(self, source: str, by: socket.socket) -> None:
        target = (source if ":" in source else "127.0.0.1", self.first.getsockname()[1])
        other = self.queues.second if by is self.first else self.first
        with socket.create_connection(target, WAIT, source_address=(source, 0)):
            by.accept()[0].close()
            if other.fileno() >= 0:
                other.setblocking(False)
                with pytest.raises(BlockingIOError):
                    other.accept()
                other.settimeout(WAIT)


@pytest.fixture
def port() -> Iterator[Callable[..., Port]]:
    with contextlib.ExitStack() as stack:

        def opened(host: str, *known: str) -> Port:
            port = Port(host, *known)
            stack.enter_context(port.first)
            stack.enter_context(port.queues.second)
            return port

        yield opened


@pytest.mark.nightly
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", "::"])
def test_the_kernel_sorts_connections(port: Callable[..., Port], host: str) -> None:
    both = port(host, "127.0.0.2/32", "127.0.1.0/24")
    for source in ("127.0.0.2", "127.0.1.9"):
        both.accepts(source, both.first)
    for source in ("127.0.0.3", "127.0.2.1"):
        both.accepts(source, both.queues.second)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("known", "first"), [("::1", True), ("::/0", True), ("::2", False), ("127.0.0.0/8", False)]
)
def test_the_kernel_sorts_connections_of_ipv6(port: Callable[..., Port], known: str, first: bool) -> None:
    both = port("::", known)
    both.accepts("::1", both.first if first else both.queues.second)


@pytest.mark.nightly
def test_a_full_queue_keeps_no_host_of_the_other_one_out(port: Callable[..., Port]) -> None:
    both = port("127.0.0.1", "127.0.0.2/32")
    both.queues.second.listen(1)
    with contextlib.ExitStack() as stack:
        with pytest.raises(TimeoutError):
            for _ in range(10):
                stack.enter_context(
                    socket.create_connection(both.first.getsockname(), 0.3, source_address=("127.0.0.3", 0))
                )
        with socket.create_connection(both.first.getsockname(), WAIT, source_address=("127.0.0.2", 0)):
            both.first.accept()[0].close()


@pytest.mark.nightly
def test_a_new_policy_changes_the_queues(port: Callable[..., Port]) -> None:
    both = port("127.0.0.1", "127.0.0.2/32")
    both.program = first_for(networks("127.0.0.3/32"))
    both.queues.update()
    both.accepts("127.0.0.3", both.first)
    both.accepts("127.0.0.2", both.queues.second)


@pytest.mark.nightly
def test_the_first_socket_outlives_the_second(port: Callable[..., Port]) -> None:
    both = port("127.0.0.1", "127.0.0.2/32")
    both.queues.second.close()
    for source in ("127.0.0.2", "127.0.0.3"):
        both.accepts(source, both.first)
    both.queues = SourceQueues(both.first, lambda: both.program, BACKLOG)
    both.queues.second.settimeout(WAIT)
    both.accepts("127.0.0.2", both.first)
    both.accepts("127.0.0.3", both.queues.second)
    both.queues.second.close()


@pytest.mark.nightly
def test_a_port_with_two_sockets_is_in_use(port: Callable[..., Port]) -> None:
    both = port("127.0.0.1")
    with pytest.raises(OSError, match="in use"):
        listen("127.0.0.1", both.first.getsockname()[1])


def test_a_new_policy_sorts_connections() -> None:
    policies = [compile_policy(f"[Nodes]\ndefault = {host}\n", file="a.ini") for host in ("10.0.0.1", "*")]
    policy = policies[0]
    program = NamedFirst(lambda: policy)
    before = program()
    assert program() is before
    policy = policies[1]
    assert program() != before


def test_hosts_that_the_policy_names_are_accepted_first() -> None:
    rules = "default = team 10.1.0.0/16\n/guest/** = *\n"
    policy = compile_policy(f"[Groups]\nteam = 10.0.0.1 fd77::/64\n[Nodes]\n{rules}", file="a.ini")
    program = NamedFirst(lambda: policy)()
    for text in ("10.0.0.1", "10.1.9.9", "fd77::9", "127.0.0.1", "::1"):
        assert choose(program, address_of(text)) == FIRST
    for text in ("10.0.0.2", "10.2.0.1", "fd78::9", "::2"):
        assert choose(program, address_of(text)) == SECOND


def test_blocked_hosts_are_accepted_after_named_hosts() -> None:
    known, blocked = networks("10.0.0.0/16", "fd00::/64"), ["10.0.0.7", "fd00::7"]
    program = first_for(known, map(address_of, blocked))
    for source, socket_number in (
        ("10.0.0.7", SECOND),
        ("fd00::7", SECOND),
        ("10.0.0.8", FIRST),
        ("fd00::8", FIRST),
    ):
        assert choose(program, address_of(source)) == socket_number, source
    many = [address_of(f"10.0.{number >> 8}.{number & 255}") for number in range(1000)]
    program = first_for(known, many)
    assert choose(program, address_of("10.0.200.1")) == FIRST
    assert choose(program, address_of("192.0.2.1")) == SECOND


def test_a_block_makes_a_new_program() -> None:
    policies = [compile_policy("[Nodes]\n/a = 10.0.0.0/24\n", file="a.ini")]
    program = NamedFirst(lambda: policies[-1])
    before = program()
    policies.append(replace(policies[0], blocks={address_of("192.0.2.7"): "blocked"}))
    assert program() == before
    policies.append(replace(policies[0], blocks={address_of("10.0.0.7"): "blocked"}))
    assert choose(program(), address_of("10.0.0.7")) == SECOND
    assert choose(before, address_of("10.0.0.7")) == FIRST
