"""Peers that wait at the relay: whose place goes to whom."""

from appliance.quotas.pool import Standing
from appliance.quotas.table import RELAY_HEADERS
from appliance.relay.connections.memory import HostShares
from appliance.relay.connections.pending_connections import Anteroom


class World:
    """An anteroom, its clock, and the hosts with a grant."""

    def __init__(self) -> None:
        self.now = 0.0
        self.granted: set[str] = set()
        self.held = HostShares("bytes", RELAY_HEADERS.bounds, self.standing)
        self.room = Anteroom(lambda: self.now, self.standing, self.held)

    def standing(self, host: str) -> Standing:
        """A host with a grant is known."""
        return Standing.REGISTERED if host in self.granted else Standing.STRANGER

    def guest(self, host: str) -> "Peer":
        """A peer that has come."""
        peer = Peer(self.room)
        self.room.enter(peer, host)
        return peer


class Peer:
    """A peer that waits."""

    def __init__(self, room: Anteroom) -> None:
        self.room, self.ended = room, False

    def make_room(self) -> None:
        """Go."""
        self.ended = True
        self.room.leave(self)


def test_strangers_go_first_and_who_has_a_grant_only_after_a_while() -> None:
    """A stranger that has just come goes before a host with a grant, who has a second for its header."""
    world = World()
    world.granted |= {"robot", "guest"}
    granted, stranger = world.guest("guest"), world.guest("nobody")
    assert world.room.make_room("robot")
    assert (granted.ended, stranger.ended) == (False, True)
    assert not world.room.make_room("robot")
    world.now = 1.5
    assert not world.room.make_room("nobody")
    assert world.room.make_room("robot")
    assert granted.ended


def test_who_gets_a_grant_while_it_waits_is_a_stranger_no_more() -> None:
    """The grant is on its way while the peer is faster: it keeps its place."""
    world = World()
    early, stranger = world.guest("robot"), world.guest("nobody")
    world.granted.add("robot")
    assert world.room.make_room("other")
    assert (early.ended, stranger.ended) == (False, True)


def test_long_headers_make_room_for_short_ones() -> None:
    """Strangers and guests with as many long headers as they can: a header as nodes send it always has room."""
    world = World()
    world.granted |= {"robot", *(f"guest{number}" for number in range(200))}
    for number in range(200):
        for host in (f"guest{number}", f"stranger{number}"):
            for _ in range(10):
                world.room.hold(world.guest(host), 64 << 10)
    assert world.held.total <= world.held.bounds.whole
    assert world.held.held_by(Standing.STRANGER) <= world.held.bounds.strangers
    mine = world.guest("robot")
    assert world.room.hold(mine, 4096) == ""
    world.now = 2.0
    assert world.room.hold(mine, 64 << 10) == ""
    assert not mine.ended


def test_a_host_at_its_share_of_long_headers_ends_nobody() -> None:
    """It is refused, and what it has stays."""
    world = World()
    peers = [world.guest("greedy") for _ in range(300)]
    refusals = [world.room.hold(peer, 64 << 10) for peer in peers]
    assert "the share of one host" in refusals[-1]
    assert not any(peer.ended for peer in peers)
    for peer in peers:
        world.room.leave(peer)
    assert world.held.total == 0
