from appliance.audit.log.budget import RATE, THE_ROBOT, Budget, DiskGroup, DiskParts, weight
from appliance.audit.log.record import AuditRecord
from appliance.quotas.pool import Bounds, QuotaClass

ROBOT, GUEST = "10.0.0.1", "10.0.0.66"
BOUNDS = Bounds(whole=1 << 40, host=1 << 20, unknown=0, kept=1 << 39)
RESERVE = Bounds(whole=1 << 20, host=1 << 16, unknown=0, kept=1 << 18)


class Desk:
    def __init__(self) -> None:
        self.now = 100.0
        self.registered = {ROBOT}
        self.network: list[str] = []
        self.budget = Budget(
            self.quota_class,
            bounds=BOUNDS,
            reserve=RESERVE,
            parts=DiskParts(self.group_of),
            clock=lambda: self.now,
        )

    def group_of(self, host: str) -> DiskGroup | None:
        if host in self.network:
            return DiskGroup("10.5.0.0/24")
        return THE_ROBOT if host == ROBOT else None

    def quota_class(self, host: str) -> QuotaClass:
        return QuotaClass.REGISTERED if host in self.registered else QuotaClass.NAMED

    def spend(self, host: str, size: int = 1 << 21) -> AuditRecord:
        record = AuditRecord(id="0", time=0, event="decision", host=host, detail={"key": "k" * (size // 2)})
        self.budget.charge(record)
        return record


def test_a_host_in_debt_waits_until_it_is_paid() -> None:
    desk = Desk()
    desk.spend(GUEST)
    assert desk.budget.pause(GUEST) == 1.0
    assert GUEST in desk.budget.owing(GUEST)
    assert desk.budget.pause(ROBOT) == 0
    desk.now += (1 << 20) / RATE + 1
    assert desk.budget.pause(GUEST) == 0
    desk.now += 60
    assert desk.budget.pause(GUEST) == 0
    assert not list(desk.budget.owed.holders())  # a host without debt uses no memory


def test_a_folded_record_costs_nothing() -> None:
    desk = Desk()
    record = desk.spend(GUEST)
    desk.budget.correct(record, -1)
    assert desk.budget.pause(GUEST) == 0


def test_two_hundred_hosts_leave_the_robot_its_quota() -> None:
    desk = Desk()
    guests = [f"10.1.{number // 100}.{number % 100}" for number in range(200)]
    for guest in guests:
        desk.spend(guest)
    assert all(desk.budget.pause(guest) > 0 for guest in guests)
    for _ in range(10):
        desk.spend(ROBOT, 1 << 16)
        desk.now += 1
        assert desk.budget.pause(ROBOT) == 0


def test_unknown_hosts_have_no_debt() -> None:
    desk = Desk()
    for number in range(1000):
        unknown = AuditRecord(id="0", time=0, event="decision", host=f"10.9.0.{number}", unknown=True)
        desk.budget.charge(unknown)
        desk.budget.correct(unknown, -1)
    assert not list(desk.budget.owed.holders())
    assert desk.budget.pause("10.9.0.1") == 0


def test_a_nearly_full_disk_lowers_every_quota() -> None:
    desk = Desk()
    desk.spend(GUEST, 1 << 18)
    desk.now += 0.2
    assert desk.budget.pause(GUEST) == 0
    desk.budget.room(RESERVE.whole - 1)
    assert desk.budget.pause(GUEST) == 0  # records that were cheap when they were made
    desk.spend(GUEST, 1 << 14)
    assert desk.budget.pause(GUEST) == 1.0
    assert desk.budget.pause(ROBOT) == 0
    desk.budget.room(None)
    assert desk.budget.pause(GUEST) == 0


def test_a_debt_beyond_the_bound_stays_one_when_the_disk_fills() -> None:
    desk = Desk()
    desk.spend(GUEST, 1 << 21)
    assert desk.budget.pause(GUEST) == 1.0
    desk.budget.room(RESERVE.whole - 1)
    assert desk.budget.pause(GUEST) == 1.0


def test_the_robot_waits_once_it_owes_its_part_of_the_disk() -> None:
    desk = Desk()
    desk.budget.room(None, 1 << 30)
    for _ in range(120):
        desk.spend(ROBOT)
    assert desk.budget.pause(ROBOT) == 0
    for _ in range(12):
        desk.spend(ROBOT)
    desk.now += 0.2
    assert desk.budget.pause(ROBOT) == 1.0
    assert "its part of the free disk space is used up" in desk.budget.owing(ROBOT)
    desk.budget.room(None, 1 << 33)
    desk.now += 0.2
    assert desk.budget.pause(ROBOT) == 0


def test_a_part_that_shrinks_forgives_what_it_shrank_by() -> None:
    desk = Desk()
    desk.budget.room(None, 1 << 30)
    for _ in range(120):
        desk.spend(ROBOT)
    assert desk.budget.pause(ROBOT) == 0
    desk.budget.room(None, 1 << 28)  # another program filled the disk
    desk.now += 0.2
    assert desk.budget.pause(ROBOT) == 0
    desk.spend(ROBOT)
    desk.now += 0.2
    assert desk.budget.pause(ROBOT) == 1.0


def test_hosts_of_a_network_share_its_part_and_keep_their_own() -> None:
    desk = Desk()
    desk.network = [f"10.5.0.{number}" for number in range(8)]
    first, second, *_ = desk.network
    desk.budget.room(None, 64 << 22)  # the network's part is 4 MiB
    desk.spend(first)
    assert desk.budget.pause(first) == 0
    for _ in range(3):
        desk.spend(first)
    desk.now += 0.2
    assert desk.budget.pause(first) == 1.0
    desk.spend(second, 1 << 19)
    assert desk.budget.pause(second) == 0


def test_a_log_that_is_behind_holds_guests_first_and_the_robot_last() -> None:
    desk = Desk()
    desk.network = [GUEST]
    desk.budget.room(None, 1 << 40)
    held = {}
    for host in (GUEST, ROBOT):
        desk.spend(host)
    for full in (0.0, 0.3, 0.8, 0.0):
        desk.budget.parts.queue(full)
        desk.now += 0.2
        held[full] = [desk.budget.pause(host) > 0 for host in (GUEST, ROBOT)]
    assert held == {0.0: [False, False], 0.3: [True, False], 0.8: [True, True]}


def test_the_last_of_the_disk_is_kept() -> None:
    desk = Desk()
    desk.registered.clear()  # as after a restart
    desk.budget.room(RESERVE.kept - 1)
    assert "kept for the robot and for hosts that the policy names" in desk.budget.shut_out(GUEST)
    assert desk.budget.shut_out(ROBOT) == ""
    desk.budget.room(None)
    assert desk.budget.shut_out(GUEST) == ""


def test_every_text_of_a_peer_counts() -> None:
    plain = weight(AuditRecord(id="0", time=0, event="decision", host=GUEST))
    long = "x" * 1000
    for record in (
        AuditRecord(id="0", time=0, event="decision", host=GUEST, caller_id=long),
        AuditRecord(id="0", time=0, event="decision", host=GUEST, resource=long),
        AuditRecord(id="0", time=0, event="decision", host=GUEST, reason=long),
        AuditRecord(id="0", time=0, event="decision", host=GUEST, detail={"key": long}),
    ):
        assert weight(record) > plain + 1000
