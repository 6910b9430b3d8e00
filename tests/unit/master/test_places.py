"""The ports of incarnations: kept over a restart, and not given to another while somebody may knock there."""

import ipaddress
import socket
from collections.abc import Iterator

import pytest

from appliance.master.places import NoPortError, Places
from appliance.master.registry import Incarnation
from appliance.ros.uris import parse_node_uri


@pytest.fixture
def first() -> Iterator[int]:
    """The first of eight ports that are free at this moment."""
    for port in range(40_000, 60_000, 8):
        probes = [socket.socket() for _ in range(8)]
        try:
            for offset, probe in enumerate(probes):
                probe.bind(("127.0.0.1", port + offset))
        except OSError:
            continue
        finally:
            for probe in probes:
                probe.close()
        yield port
        return
    pytest.fail("no eight free ports in a row")


def places(first: int, relays: int = 1) -> Places:
    """Nobody keeps the sockets."""
    ports = range(first, first + 8)
    return Places("127.0.0.1", ports, keep=lambda *_: None, drop=lambda _: None, relays=relays)


def incarnation(ports: tuple[int, ...]) -> Incarnation:
    """Somebody with these ports."""
    uri = "http://127.0.0.1:4000/"
    host = ipaddress.ip_address("127.0.0.1")
    outer, relay, *more = ports
    api = parse_node_uri(uri)
    return Incarnation(
        "key", "/node", host, api, uri, "127.0.0.1", outer, relay, more_relay_ports=tuple(more)
    )


def test_closed_ports_come_last(first: int) -> None:
    """Ports that were given back are given out again only after all others."""
    here = places(first)
    closed = here.open()
    here.close(incarnation(closed))
    others = [here.open() for _ in range(3)]
    assert closed not in others
    assert here.open() == closed
    here.close_unclaimed(set())


def test_after_a_restart_too(first: int) -> None:
    """A restarted control begins after the ports in use: what was closed before the crash is not given out first."""
    before = places(first)
    before.open()
    kept = before.open()
    after = places(first)
    for port in kept:
        after.adopt(f"port:{port}", before.socket(port).dup())
    after.close_unclaimed(set(kept))
    assert after.open() == (first + 4, first + 5)
    before.close_unclaimed(set())
    after.close_unclaimed(set())


def test_a_port_for_every_relay(first: int) -> None:
    """And the words that say so when there is none left."""
    here = places(first, relays=3)
    opened = [here.open(), here.open()]
    assert [len(ports) for ports in opened] == [4, 4]
    here.close(incarnation(opened[0]))
    assert here.open() == opened[0]
    with pytest.raises(NoPortError, match="4 per node"):
        here.open()
    here.close_unclaimed(set())


def test_other_relays_after_a_restart_of_the_appliance(first: int) -> None:
    """A node has as many ports as there are relays now; those it had and needs are the same."""
    before = places(first, relays=2)
    node = incarnation(before.open())
    had = node.ports
    before.close_unclaimed(set())
    more = places(first, relays=3)
    assert more.reopen(node)
    assert (node.ports[:3], len(set(node.ports))) == (had, 4)
    more.close_unclaimed(set())
    fewer = places(first, relays=1)
    assert fewer.reopen(node)
    assert node.ports == had[:2]
    fewer.close_unclaimed(set())


def test_a_port_of_another_range_is_not_given_out(first: int) -> None:
    """What was kept from before the policy had this range is closed, and is nobody's from then on."""
    before = Places("127.0.0.1", range(first + 4, first + 8), keep=lambda *_: None, drop=lambda _: None)
    kept = before.open()
    dropped: list[str] = []
    after = Places("127.0.0.1", range(first, first + 4), keep=lambda *_: None, drop=dropped.append)
    for port in kept:
        after.adopt(f"port:{port}", before.socket(port).dup())
    before.close_unclaimed(set())
    after.close_unclaimed(set())
    assert dropped == [f"port:{port}" for port in kept]
    assert [*after.open(), *after.open()] == [*range(first, first + 4)]
    with pytest.raises(NoPortError):
        after.open()
    after.close_unclaimed(set())
