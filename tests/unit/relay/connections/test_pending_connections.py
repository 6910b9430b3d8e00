from appliance.quotas.pool import QuotaClass
from appliance.quotas.table import RELAY_HEADERS
from appliance.relay.connections.incoming_connection import PendingConnections
from appliance.relay.transport.memory import MemoryPool


class World:
    def __init__(self) -> None:
        self.now = 0.0
        self.granted: set[str] = set()
        self.held = MemoryPool("bytes", RELAY_HEADERS.bounds, self.quota_class)
        self.room = PendingConnections(lambda: self.now, self.quota_class, self.held)

    def quota_class(self, host: str) -> QuotaClass:
        return QuotaClass.REGISTERED if host in self.granted else QuotaClass.UNKNOWN

    def guest(self, host: str) -> "Peer":
        peer = Peer(self.room)
        self.room.enter(peer, host)
        return peer


class Peer:
    def __init__(self, room: PendingConnections) -> None:
        self.room, self.ended = room, False

    def make_room(self) -> None:
        self.ended = True
        self.room.leave(self)


def test_unknown_hosts_make_room_before_hosts_with_a_grant() -> None:
    world = World()
    world.granted |= {"robot", "guest"}
    granted, unknown = world.guest("guest"), world.guest("nobody")
    assert world.room.make_room("robot")
    assert (granted.ended, unknown.ended) == (False, True)
    assert not world.room.make_room("robot")
    world.now = 1.5
    assert not world.room.make_room("nobody")
    assert world.room.make_room("robot")
    assert granted.ended


def test_a_grant_counts_for_a_waiting_peer() -> None:
    world = World()
    early, unknown = world.guest("robot"), world.guest("nobody")
    world.granted.add("robot")
    assert world.room.make_room("other")
    assert (early.ended, unknown.ended) == (False, True)


def test_long_headers_make_room_for_short_ones() -> None:
    world = World()
    world.granted |= {"robot", *(f"guest{number}" for number in range(200))}
    short = world.guest("early")
    world.room.hold(short, 4096)
    for number in range(200):
        for host in (f"guest{number}", f"unknown{number}"):
            for _ in range(10):
                world.room.hold(world.guest(host), 64 << 10)
    assert world.held.total <= world.held.bounds.whole
    assert world.held.held_by(QuotaClass.UNKNOWN) <= world.held.bounds.unknown
    mine = world.guest("robot")
    assert world.room.hold(mine, 4096) == ""
    world.now = 2.0
    assert world.room.hold(mine, 64 << 10) == ""
    assert (mine.ended, short.ended) == (False, False)


def test_a_host_at_its_quota_of_long_headers_ends_no_other() -> None:
    world = World()
    peers = [world.guest("greedy") for _ in range(300)]
    refusals = [world.room.hold(peer, 64 << 10) for peer in peers]
    assert "the quota of one host" in refusals[-1]
    assert not any(peer.ended for peer in peers)
    for peer in peers:
        world.room.leave(peer)
    assert world.held.total == 0


def test_a_connection_with_a_short_header_gives_no_memory_back() -> None:
    world = World()
    long, short = world.guest("robot"), world.guest("robot")
    world.room.hold(long, 64 << 10)
    before = world.held.total
    world.room.leave(short)
    assert world.held.total == before
