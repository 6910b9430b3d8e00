import ipaddress
import math
from dataclasses import dataclass, field

from hypothesis import given
from hypothesis import strategies as st

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, QuotaClass
from appliance.quotas.table import RVMASTER_CONNECTIONS
from appliance.rpc.connection_table import ConnectionTable, Stage

ROBOT, OTHER = ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.2")


def guest(number: int) -> Address:
    return ipaddress.ip_address("10.1.0.0") + number


@dataclass
class QuotaClasses:
    of: dict[Address, QuotaClass] = field(default_factory=dict)
    now: float = 0.0

    def __call__(self, host: Address) -> QuotaClass:
        return self.of.get(host, QuotaClass.UNKNOWN)

    def clock(self) -> float:
        return self.now


@dataclass(eq=False)
class Guest:
    connection_table: ConnectionTable[Address]
    host: Address
    deadline: float = 0.0
    progress: float = 0.0
    holding: int = 0
    cut: bool = False

    def expire(self) -> None: ...

    def abort(self) -> None:
        self.cut = True
        self.connection_table.release(self.host, self.holding)
        self.connection_table.leave(self)

    def hold(self, size: int) -> str:
        why = self.connection_table.hold(self.host, size)
        if not why:
            self.holding += size
        return why


def books(
    quota_classes: QuotaClasses, connections: Bounds, held: Bounds | None = None
) -> ConnectionTable[Address]:
    bytes_ = held or Bounds(1000, 1000, 0, 0)
    return ConnectionTable(
        quota_classes,
        connections=connections,
        held=bytes_,
        farewells=Bounds(2, 1, 1, 0),
        clock=quota_classes.clock,
    )


def come(
    connection_table: ConnectionTable[Address], host: Address, stage: Stage = Stage.IDLE
) -> Guest | None:
    connection = Guest(connection_table, host)
    if connection_table.enter(connection, host):
        return None
    connection_table.file(connection, stage)
    return connection


def test_many_addresses_do_not_keep_a_named_host_out() -> None:
    quota_classes = QuotaClasses(
        {guest(n): QuotaClass.NAMED for n in range(200, 212)} | {ROBOT: QuotaClass.NAMED}
    )
    connection_table = books(quota_classes, Bounds(whole=400, host=50, unknown=40, kept=100))
    for number in range(212):
        for _ in range(50):
            come(connection_table, guest(number))
        assert connection_table.connected.held_by(QuotaClass.UNKNOWN) <= 40
    assert connection_table.connected.total == 300
    mine = [come(connection_table, ROBOT) for _ in range(50)]
    assert all(one is not None and not one.cut for one in mine)
    assert connection_table.connected.total == 300
    assert connection_table.connected.held_by(QuotaClass.UNKNOWN) == 0


def test_a_registered_host_gets_the_reserve() -> None:
    """All other connections are being served, so none can make room, and only the reserve is left."""
    quota_classes = QuotaClasses({OTHER: QuotaClass.NAMED, ROBOT: QuotaClass.REGISTERED})
    connection_table = books(quota_classes, Bounds(whole=10, host=10, unknown=0, kept=4))
    assert sum(come(connection_table, OTHER, Stage.SERVED) is not None for _ in range(10)) == 6
    assert sum(come(connection_table, ROBOT, Stage.SERVED) is not None for _ in range(10)) == 4


def test_only_a_lower_class_makes_room() -> None:
    quota_classes = QuotaClasses({OTHER: QuotaClass.NAMED, ROBOT: QuotaClass.REGISTERED})
    connection_table = books(quota_classes, Bounds(whole=3, host=3, unknown=1, kept=0))
    unknown = come(connection_table, guest(1), Stage.UNFINISHED)
    named, own = come(connection_table, OTHER), come(connection_table, ROBOT)
    assert unknown and named and own
    assert come(connection_table, ROBOT)
    assert (unknown.cut, named.cut, own.cut) == (True, False, False)
    assert come(connection_table, ROBOT)
    assert (named.cut, own.cut) == (True, False)
    assert come(connection_table, OTHER) is None
    assert not own.cut


def test_an_unfinished_request_of_the_same_class_has_its_time() -> None:
    quota_classes = QuotaClasses({OTHER: QuotaClass.NAMED, ROBOT: QuotaClass.NAMED})
    connection_table = books(quota_classes, Bounds(whole=1, host=1, unknown=0, kept=0))
    slow = come(connection_table, OTHER, Stage.UNFINISHED)
    assert slow
    assert come(connection_table, ROBOT) is None
    quota_classes.now = 1.5
    assert come(connection_table, ROBOT)
    assert slow.cut


def test_a_host_at_its_own_quota_ends_only_its_own_idle_connections() -> None:
    quota_classes = QuotaClasses({ROBOT: QuotaClass.NAMED, OTHER: QuotaClass.UNKNOWN})
    connection_table = books(quota_classes, Bounds(whole=4, host=2, unknown=1, kept=0))
    recent, old, other = (come(connection_table, host) for host in (ROBOT, ROBOT, OTHER))
    assert recent and old and other
    recent.progress = quota_classes.now = 5.0
    assert come(connection_table, ROBOT, Stage.SERVED)
    assert (recent.cut, old.cut, other.cut) == (False, True, False)
    assert come(connection_table, ROBOT, Stage.UNFINISHED)
    assert connection_table.enter(Guest(connection_table, ROBOT), ROBOT).startswith(
        "10.0.0.1 has 2 connections open"
    )
    assert not other.cut


def test_two_hundred_nodes_of_one_machine_are_all_served() -> None:
    """Each keeps a connection to RVMaster and to five other nodes, more than the quota of its machine."""
    quota_classes = QuotaClasses({ROBOT: QuotaClass.REGISTERED})
    connection_table: ConnectionTable[Address] = ConnectionTable(quota_classes, clock=quota_classes.clock)
    for _ in range(200 * 6):
        quota_classes.now += 0.001
        connection = come(connection_table, ROBOT, Stage.SERVED)
        assert connection is not None
        connection.progress = quota_classes.now
        connection_table.file(connection, Stage.IDLE)
    assert connection_table.connected.total == RVMASTER_CONNECTIONS.bounds.host


def test_a_host_that_registers_is_no_longer_unknown() -> None:
    quota_classes = QuotaClasses({ROBOT: QuotaClass.NAMED})
    connection_table = books(quota_classes, Bounds(whole=2, host=2, unknown=2, kept=0))
    risen, unknown = come(connection_table, guest(1)), come(connection_table, guest(2))
    quota_classes.of[guest(1)] = QuotaClass.REGISTERED
    assert risen and unknown
    assert come(connection_table, ROBOT)
    assert (risen.cut, unknown.cut) == (False, True)


def test_connections_turned_away_in_all() -> None:
    quota_classes = QuotaClasses({ROBOT: QuotaClass.NAMED, OTHER: QuotaClass.NAMED})
    connection_table = books(quota_classes, Bounds(1, 1, 0, 0))
    told = Guest(connection_table, ROBOT)
    assert connection_table.turn_away(told, ROBOT)
    assert not connection_table.turn_away(Guest(connection_table, ROBOT), ROBOT)
    assert connection_table.turn_away(Guest(connection_table, OTHER), OTHER)
    connection_table.leave(told)
    assert connection_table.turn_away(Guest(connection_table, ROBOT), ROBOT)


def test_bytes_are_freed_by_the_host_that_holds_most() -> None:
    quota_classes = QuotaClasses(dict.fromkeys((ROBOT, OTHER, guest(1)), QuotaClass.REGISTERED))
    connection_table = books(
        quota_classes, Bounds(9, 9, 0, 0), Bounds(whole=100, host=100, unknown=0, kept=0)
    )
    large, small, mine = (come(connection_table, host, Stage.UNFINISHED) for host in (OTHER, guest(1), ROBOT))
    assert large and small and mine
    assert (large.hold(60), small.hold(40), mine.hold(20)) == ("", "", "")
    assert (large.cut, small.cut) == (True, False)
    assert small.hold(40) == ""
    assert small.hold(1).startswith("all hosts together have 100 bytes")
    assert not mine.cut
    assert connection_table.held.total == 100


@given(
    steps=st.lists(
        st.tuples(
            st.integers(0, 5),
            st.sampled_from([*Stage, None]),
            st.sampled_from(list(QuotaClass)),
            st.booleans(),
        ),
        max_size=60,
    )
)
def test_no_order_of_events_loses_count(steps: list[tuple[int, Stage | None, QuotaClass, bool]]) -> None:
    quota_classes, here = QuotaClasses(), list[Guest]()
    connection_table = books(quota_classes, Bounds(whole=6, host=3, unknown=2, kept=2))
    for number, stage, quota_class, risen in steps:
        host = guest(number)
        quota_classes.now += 0.4
        if risen:
            quota_classes.of[host] = quota_class
        if stage is None and here:
            connection_table.leave(here.pop(number % len(here)))
        elif stage is not None and (connection := come(connection_table, host, stage)) is not None:
            here.append(connection)
        here = [one for one in here if not one.cut]
        assert connection_table.connected.total == len(here) == len(connection_table.connections) <= 6


def test_an_idle_connection_that_was_used_waits_from_then_on() -> None:
    quota_classes = QuotaClasses(dict.fromkeys((ROBOT, OTHER, guest(1)), QuotaClass.REGISTERED))
    connection_table = books(quota_classes, Bounds(3, 3, 0, 0))
    used, unused, last = (come(connection_table, host) for host in (ROBOT, OTHER, ROBOT))
    assert used and unused and last
    quota_classes.now = used.progress = 5.0
    connection_table.file(used, Stage.IDLE)
    assert come(connection_table, guest(1))
    assert (used.cut, unused.cut, last.cut) == (False, True, False)
    assert come(connection_table, guest(1))
    assert (used.cut, last.cut) == (False, True)
    quota_classes.now = 6.0
    assert come(connection_table, guest(1))
    assert used.cut


def test_served_connections_of_unknown_hosts_may_make_room() -> None:
    quota_classes = QuotaClasses({ROBOT: QuotaClass.REGISTERED, OTHER: QuotaClass.REGISTERED})
    connection_table: ConnectionTable[Address] = ConnectionTable(
        quota_classes,
        connections=Bounds(1, 1, 1, 0),
        patience=lambda quota_class, _stage, _own: math.inf if quota_class is QuotaClass.REGISTERED else 0.0,
        clock=quota_classes.clock,
    )
    unknown = come(connection_table, guest(0), Stage.SERVED)
    assert unknown is not None
    robot = come(connection_table, ROBOT, Stage.SERVED)
    assert unknown.cut
    assert robot is not None
    assert come(connection_table, OTHER) is None
    assert not robot.cut
