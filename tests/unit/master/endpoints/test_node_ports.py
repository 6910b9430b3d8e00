import errno
import ipaddress
import os
import socket
from collections import deque
from typing import Any

import pytest

from appliance.master.endpoints.node_ports import NodePorts, NoPortError
from appliance.master.graph.registry import Incarnation
from appliance.policy.model import Address
from appliance.policy.policy import DEFAULT_PORTS
from appliance.policy.policy_compiler import compile_policy
from appliance.quotas.table import NODE_PORTS
from tests.support.incarnations import incarnation
from tests.support.memory_ports import listening, memory_ports

FIRST = 20_000


def places(relays: int = 1, first: int = FIRST, count: int = 8, **more: Any) -> NodePorts:
    return memory_ports(lambda: NAMING, range(first, first + count), relays=relays, **more)


NAMING = compile_policy("[Nodes]\n/** = 10.0.0.1 10.1.0.0/24\n", file="a.ini")
HOSTS = [ipaddress.ip_address(f"10.0.0.{number}") for number in range(1, 9)]


def node_of(host: Address, *ports: int) -> Incarnation:
    return incarnation("/node", host=str(host), ports=ports)


def test_closed_ports_are_reused_last() -> None:
    here = places()
    closed = here.open(HOSTS[0])
    here.close(node_of(HOSTS[0], *closed))
    others = [here.open(host) for host in HOSTS[1:4]]
    assert closed not in others
    assert here.open(HOSTS[0]) == closed


def test_closed_ports_are_reused_last_after_a_restart() -> None:
    before = places()
    before.open(HOSTS[0])
    kept = before.open(HOSTS[0])
    after = places()
    for port in kept:
        after.adopt(f"port:{port}", before.socket(port))
    after.close_unclaimed(set(kept))
    assert after.open(HOSTS[0]) == (FIRST + 4, FIRST + 5)
    before.close_unclaimed(set())


def test_a_port_for_every_relay() -> None:
    here = places(relays=3)
    opened = [here.open(HOSTS[0]), here.open(HOSTS[1])]
    assert [len(ports) for ports in opened] == [4, 4]
    here.close(node_of(HOSTS[0], *opened[0]))
    assert here.open(HOSTS[0]) == opened[0]
    with pytest.raises(NoPortError, match="4 per node"):
        here.open(HOSTS[0])


def test_another_number_of_relays_after_a_restart() -> None:
    before = places(relays=2)
    node = node_of(HOSTS[0], *before.open(HOSTS[0]))
    had = node.ports
    before.close_unclaimed(set())
    more = places(relays=3)
    more.reopen(node)
    assert (node.ports[:3], len(set(node.ports))) == (had, 4)
    more.close_unclaimed(set())
    fewer = places(relays=1)
    fewer.reopen(node)
    assert node.ports == had[:2]


def test_a_restored_node_whose_port_another_program_has_gets_an_unused_one() -> None:
    """Such as a process of the earlier appliance that has not ended yet: a ROS 1 node never registers twice."""
    taken = {FIRST, FIRST + 1, FIRST + 3}

    def busy(host: str, port: int) -> Any:
        if port in taken:
            raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))
        return listening(host, port)

    here = places(listen=busy)
    first, second = node_of(HOSTS[0], FIRST, FIRST + 1), node_of(HOSTS[1], FIRST + 2, FIRST + 3)
    here.reserve((*first.ports, *second.ports))
    here.reopen(first)
    here.reopen(second)
    assert (first.ports, second.ports) == ((FIRST + 4, FIRST + 5), (FIRST + 2, FIRST + 6))
    here.close_unclaimed({*first.ports, *second.ports})
    taken.clear()
    assert [here.open(HOSTS[2]), here.taken.total] == [(FIRST + 7, FIRST), 6]
    lost = node_of(HOSTS[0], FIRST + 20, FIRST + 21)
    taken.update(range(FIRST, FIRST + 30))
    here.unused = deque([FIRST + 1])
    with pytest.raises(NoPortError, match="in use"):
        here.reopen(lost)


def test_no_port_is_lost_while_none_can_be_opened() -> None:
    def exhausted(_host: str, _port: int) -> socket.socket:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    held = places(listen=exhausted)
    for _try in range(20):
        with pytest.raises(NoPortError, match="Too many open files"):
            held.open(HOSTS[0])
    assert sorted(held.unused) == list(range(FIRST, FIRST + 8))


def test_a_port_of_an_earlier_range_is_not_reused() -> None:
    before = places(first=FIRST + 4, count=4)
    kept = before.open(HOSTS[0])
    dropped: list[str] = []
    after = places(count=4, drop=dropped.append)
    for port in kept:
        after.adopt(f"port:{port}", before.socket(port))
    before.close_unclaimed(set())
    after.close_unclaimed(set())
    assert dropped == [f"port:{port}" for port in kept]
    assert [*after.open(HOSTS[0]), *after.open(HOSTS[1])] == [*range(FIRST, FIRST + 4)]
    with pytest.raises(NoPortError):
        after.open(HOSTS[0])


def test_no_host_takes_all_ports() -> None:
    here = places(relays=4, count=800)
    for host in HOSTS[:3]:
        taken = []
        with pytest.raises(NoPortError, match=r"3 times as many as are left; widen \[Ports\] range"):
            while True:
                taken.append(here.open(host))
        assert len(taken) >= 3
    assert here.taken.total <= 800 - 10
    before = here.taken.held(NAMING.named_as(HOSTS[2]))
    here.close(node_of(HOSTS[2], *taken[0]))
    assert here.taken.held(NAMING.named_as(HOSTS[2])) == before - 5
    assert here.open(HOSTS[3])


def test_a_thousand_nodes_fit_the_default_range() -> None:
    here = places(4, DEFAULT_PORTS.start, len(DEFAULT_PORTS))
    assert len({here.open(HOSTS[0]) for _ in range(1000)}) == 1000
    assert (len(DEFAULT_PORTS), DEFAULT_PORTS.stop <= 32768) == (NODE_PORTS.bounds.whole, True)


def test_many_addresses_of_one_network_are_one_host() -> None:
    here = places(relays=4, count=800)
    refused = ""
    for number in range(200):
        try:
            here.open(ipaddress.ip_address("10.1.0.0") + number)
        except NoPortError as error:
            refused = str(error)
    assert refused.startswith("10.1.0.0/24 has 600 ports (5 per node), and 200 are left")
    for _ in range(30):
        here.open(HOSTS[0])
