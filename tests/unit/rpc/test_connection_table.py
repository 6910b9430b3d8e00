"""Connections by host and standing: who has room, and who makes it."""

import ipaddress
import math
from dataclasses import dataclass, field

from hypothesis import given
from hypothesis import strategies as st

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Standing
from appliance.rpc.connection_table import Stage, Visitors

ROBOT, OTHER = ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.2")


def guest(number: int) -> Address:
    """One of many addresses."""
    return ipaddress.ip_address("10.1.0.0") + number


@dataclass
class Standings:
    """What is known of hosts, and the clock."""

    of: dict[Address, Standing] = field(default_factory=dict)
    now: float = 0.0

    def __call__(self, host: Address) -> Standing:
        """What is known of this host."""
        return self.of.get(host, Standing.STRANGER)

    def clock(self) -> float:
        """The time of the test."""
        return self.now


@dataclass(eq=False)
class Guest:
    """A connection of a test."""

    visitors: Visitors[Address]
    host: Address
    deadline: float = 0.0
    holding: int = 0
    cut: bool = False

    def expire(self) -> None:
        """Not of this test."""

    def abort(self) -> None:
        """End as a connection does."""
        self.cut = True
        self.visitors.release(self.host, self.holding)
        self.visitors.leave(self)

    def hold(self, size: int) -> str:
        """Have a body of so many bytes."""
        why = self.visitors.hold(self.host, size)
        if not why:
            self.holding += size
        return why


def books(standings: Standings, connections: Bounds, held: Bounds | None = None) -> Visitors[Address]:
    """The books of a test."""
    bytes_ = held or Bounds(1000, 1000, 0, 0)
    return Visitors(
        standings, connections=connections, held=bytes_, farewells=Bounds(2, 1, 1, 0), clock=standings.clock
    )


def come(visitors: Visitors[Address], host: Address, stage: Stage = Stage.IDLE) -> Guest | None:
    """A connection of this host, at this stage; None when it is turned away."""
    connection = Guest(visitors, host)
    if visitors.enter(connection, host):
        return None
    visitors.file(connection, stage)
    return connection


def test_many_addresses_keep_nobody_out() -> None:
    """Two hundred strangers and twelve named hosts with all they get: a named host that comes last finds room."""
    standings = Standings({guest(n): Standing.NAMED for n in range(200, 212)} | {ROBOT: Standing.NAMED})
    visitors = books(standings, Bounds(whole=400, host=50, strangers=40, kept=100))
    for number in range(212):
        for _ in range(50):
            come(visitors, guest(number))
        assert visitors.connected.held_by(Standing.STRANGER) <= 40
    assert visitors.connected.total == 300
    mine = [come(visitors, ROBOT) for _ in range(50)]
    assert all(one is not None and not one.cut for one in mine)
    assert visitors.connected.total == 300
    assert visitors.connected.held_by(Standing.STRANGER) == 0


def test_a_registered_host_finds_what_is_kept() -> None:
    """Everybody else is being served, so nobody makes room: what is kept is there, and then nothing more."""
    standings = Standings({OTHER: Standing.NAMED, ROBOT: Standing.REGISTERED})
    visitors = books(standings, Bounds(whole=10, host=10, strangers=0, kept=4))
    assert sum(come(visitors, OTHER, Stage.SERVED) is not None for _ in range(10)) == 6
    assert sum(come(visitors, ROBOT, Stage.SERVED) is not None for _ in range(10)) == 4


def test_the_lower_standing_makes_room_and_the_higher_never() -> None:
    """A stranger's unfinished request goes before a named host's idle connection; nobody ends a higher one's."""
    standings = Standings({OTHER: Standing.NAMED, ROBOT: Standing.REGISTERED})
    visitors = books(standings, Bounds(whole=3, host=3, strangers=1, kept=0))
    stranger = come(visitors, guest(1), Stage.UNFINISHED)
    named, own = come(visitors, OTHER), come(visitors, ROBOT)
    assert stranger and named and own
    assert come(visitors, ROBOT)
    assert (stranger.cut, named.cut, own.cut) == (True, False, False)
    assert come(visitors, ROBOT)
    assert (named.cut, own.cut) == (True, False)
    assert come(visitors, OTHER) is None
    assert not own.cut


def test_an_unfinished_request_of_an_equal_has_its_time() -> None:
    """A request that has just begun is not ended for another host of the same standing; one that hangs is."""
    standings = Standings({OTHER: Standing.NAMED, ROBOT: Standing.NAMED})
    visitors = books(standings, Bounds(whole=1, host=1, strangers=0, kept=0))
    slow = come(visitors, OTHER, Stage.UNFINISHED)
    assert slow
    assert come(visitors, ROBOT) is None
    standings.now = 1.5
    assert come(visitors, ROBOT)
    assert slow.cut


def test_a_host_at_its_own_share_ends_nobody() -> None:
    """It is told so, and its own connections stay."""
    standings = Standings({ROBOT: Standing.NAMED, OTHER: Standing.NAMED})
    visitors = books(standings, Bounds(whole=4, host=2, strangers=0, kept=0))
    there = [come(visitors, ROBOT), come(visitors, ROBOT), come(visitors, OTHER)]
    assert visitors.enter(Guest(visitors, ROBOT), ROBOT).startswith("10.0.0.1 has 2 connections open")
    assert not any(one.cut for one in there if one)


def test_who_registers_is_a_stranger_no_more() -> None:
    """What a host has is filed by what it was; who ends it looks at what it is now."""
    standings = Standings({ROBOT: Standing.NAMED})
    visitors = books(standings, Bounds(whole=2, host=2, strangers=2, kept=0))
    risen, stranger = come(visitors, guest(1)), come(visitors, guest(2))
    standings.of[guest(1)] = Standing.REGISTERED
    assert risen and stranger
    assert come(visitors, ROBOT)
    assert (risen.cut, stranger.cut) == (False, True)


def test_connections_turned_away_in_all() -> None:
    """Who is told that it is one too many has a share there as well, and all have one."""
    standings = Standings({ROBOT: Standing.NAMED, OTHER: Standing.NAMED})
    visitors = books(standings, Bounds(1, 1, 0, 0))
    told = Guest(visitors, ROBOT)
    assert visitors.turn_away(told, ROBOT)
    assert not visitors.turn_away(Guest(visitors, ROBOT), ROBOT)
    assert visitors.turn_away(Guest(visitors, OTHER), OTHER)
    visitors.leave(told)
    assert visitors.turn_away(Guest(visitors, ROBOT), ROBOT)


def test_bytes_are_freed_by_the_host_that_holds_most() -> None:
    """Bodies that are never finished fill the memory: the largest goes for a host that holds less, and only then."""
    standings = Standings(dict.fromkeys((ROBOT, OTHER, guest(1)), Standing.REGISTERED))
    visitors = books(standings, Bounds(9, 9, 0, 0), Bounds(whole=100, host=100, strangers=0, kept=0))
    large, small, mine = (come(visitors, host, Stage.UNFINISHED) for host in (OTHER, guest(1), ROBOT))
    assert large and small and mine
    assert (large.hold(60), small.hold(40), mine.hold(20)) == ("", "", "")
    assert (large.cut, small.cut) == (True, False)
    assert small.hold(40) == ""
    assert small.hold(1).startswith("all hosts together have 100 bytes")
    assert not mine.cut
    assert visitors.held.total == 100


@given(
    steps=st.lists(
        st.tuples(
            st.integers(0, 5), st.sampled_from([*Stage, None]), st.sampled_from(list(Standing)), st.booleans()
        ),
        max_size=60,
    )
)
def test_no_order_of_events_loses_count(steps: list[tuple[int, Stage | None, Standing, bool]]) -> None:
    """However hosts come, go and rise: what is counted is who is here, and within the bounds."""
    standings, here = Standings(), list[Guest]()
    visitors = books(standings, Bounds(whole=6, host=3, strangers=2, kept=2))
    for number, stage, standing, risen in steps:
        host = guest(number)
        standings.now += 0.4
        if risen:
            standings.of[host] = standing
        if stage is None and here:
            visitors.leave(here.pop(number % len(here)))
        elif stage is not None and (connection := come(visitors, host, stage)) is not None:
            here.append(connection)
        here = [one for one in here if not one.cut]
        assert visitors.connected.total == len(here) == len(visitors.connections) <= 6


def test_a_listener_says_who_makes_room_while_it_is_served() -> None:
    """Where strangers have no patience to claim, one that is being served makes room; a known host's never does."""
    standings = Standings({ROBOT: Standing.REGISTERED, OTHER: Standing.REGISTERED})
    visitors: Visitors[Address] = Visitors(
        standings,
        connections=Bounds(1, 1, 1, 0),
        patience=lambda standing, _stage, _own: math.inf if standing is Standing.REGISTERED else 0.0,
        clock=standings.clock,
    )
    stranger = come(visitors, guest(0), Stage.SERVED)
    assert stranger is not None
    robot = come(visitors, ROBOT, Stage.SERVED)
    assert stranger.cut
    assert robot is not None
    assert come(visitors, OTHER) is None
    assert not robot.cut
