"""Tests of what each host may cause in bytes of records, with a clock that the test moves."""

from appliance.audit.budget import RATE, Budget, weight
from appliance.audit.record import Record
from appliance.quotas.pool import Bounds, Standing

ROBOT, GUEST = "10.0.0.1", "10.0.0.66"
BOUNDS = Bounds(whole=1 << 40, host=1 << 20, strangers=0, kept=1 << 39)
RESERVE = Bounds(whole=1 << 20, host=1 << 16, strangers=0, kept=1 << 18)


class Desk:
    """A budget, the time, and what is known of hosts."""

    def __init__(self) -> None:
        self.now = 100.0
        self.registered = {ROBOT}
        self.budget = Budget(self.standing, bounds=BOUNDS, reserve=RESERVE, clock=lambda: self.now)

    def standing(self, host: str) -> Standing:
        """Who has a registration is registered, everybody else is named."""
        return Standing.REGISTERED if host in self.registered else Standing.NAMED

    def spend(self, host: str, size: int = 1 << 21) -> Record:
        """Records about a host, of so many bytes on disk, as one."""
        record = Record(id="0", time=0, event="decision", host=host, detail={"key": "k" * (size // 2)})
        self.budget.charge(record)
        return record


def test_who_owes_too_much_waits_until_it_is_paid() -> None:
    """A host beyond its share waits, for as long as its debt takes; time pays it off, and nobody else waits."""
    desk = Desk()
    desk.spend(GUEST)
    assert desk.budget.pause(GUEST) == 1.0
    assert GUEST in desk.budget.owing(GUEST)
    assert desk.budget.pause(ROBOT) == 0
    desk.now += (1 << 20) / RATE + 1
    assert desk.budget.pause(GUEST) == 0
    desk.now += 60
    assert desk.budget.pause(GUEST) == 0
    assert not list(desk.budget.owed.holders())  # who owes nothing takes no memory


def test_what_was_only_counted_costs_nothing() -> None:
    """A record that was folded is taken off again."""
    desk = Desk()
    record = desk.spend(GUEST)
    desk.budget.folded(record)
    assert desk.budget.pause(GUEST) == 0


def test_two_hundred_hosts_leave_the_robot_its_share() -> None:
    """Two hundred hosts that each owe all they may, and more, are slowed; the robot is not."""
    desk = Desk()
    guests = [f"10.1.{number // 100}.{number % 100}" for number in range(200)]
    for guest in guests:
        desk.spend(guest)
    assert all(desk.budget.pause(guest) > 0 for guest in guests)
    for _ in range(10):
        desk.spend(ROBOT, 1 << 16)
        desk.now += 1
        assert desk.budget.pause(ROBOT) == 0


def test_strangers_owe_nothing() -> None:
    """However many addresses strangers have, they take no memory here."""
    desk = Desk()
    for number in range(1000):
        stranger = Record(id="0", time=0, event="decision", host=f"10.9.0.{number}", stranger=True)
        desk.budget.charge(stranger)
        desk.budget.folded(stranger)
    assert not list(desk.budget.owed.holders())
    assert desk.budget.pause("10.9.0.1") == 0


def test_a_disk_that_is_nearly_full_slows_everybody_by_his_own_records() -> None:
    """While only the reserve is left the shares are small; who is within his own is not slowed."""
    desk = Desk()
    desk.spend(GUEST, 1 << 18)
    assert desk.budget.pause(GUEST) == 0
    desk.budget.room(RESERVE.whole - 1)
    assert desk.budget.pause(GUEST) == 1.0
    assert desk.budget.pause(ROBOT) == 0
    desk.budget.room(None)
    assert desk.budget.pause(GUEST) == 0


def test_the_last_of_the_disk_is_for_hosts_with_a_registration() -> None:
    """Of the last quarter of the reserve others get nothing, and are told so; with room again all is as before."""
    desk = Desk()
    desk.budget.room(RESERVE.kept - 1)
    assert "kept for hosts with a registration" in desk.budget.shut_out(GUEST)
    assert desk.budget.shut_out(ROBOT) == ""
    desk.budget.room(None)
    assert desk.budget.shut_out(GUEST) == ""


def test_the_weight_is_of_all_texts_of_a_peer() -> None:
    """Whatever a peer makes long is weighed: its name, the resource, the reason, the key."""
    plain = weight(Record(id="0", time=0, event="decision", host=GUEST))
    long = "x" * 1000
    for record in (
        Record(id="0", time=0, event="decision", host=GUEST, caller_id=long),
        Record(id="0", time=0, event="decision", host=GUEST, resource=long),
        Record(id="0", time=0, event="decision", host=GUEST, reason=long),
        Record(id="0", time=0, event="decision", host=GUEST, detail={"key": long}),
    ):
        assert weight(record) > plain + 1000
