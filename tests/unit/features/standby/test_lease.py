from typing import Any

import pytest

from appliance.features.standby.lease import (
    CONFIDENCE,
    FARTHEST,
    ApplianceLease,
    ClaimPromise,
    LeaseError,
    Outgoing,
    PromiseRequest,
    TakeOver,
    WitnessAnswer,
    WitnessRequest,
)
from appliance.features.standby.process import PeerChannel, WitnessChannel
from appliance.features.standby.witness.lease_file import LeaseRecord
from appliance.features.standby.witness.protocol import EXPIRY, HIGHEST
from tests.unit.features.standby.witness.robot import FIRST, KEYS, PEERS, Robot

BOTH, ALONE = frozenset("ab"), frozenset("a")


def answer_of(**changes: object) -> WitnessAnswer:
    full = {
        "ok": True, "reason": "", "epoch": 2, "holder": "a", "in_sync": BOTH, "expired": False
    } | changes  # fmt: skip
    return WitnessAnswer(**full)  # type: ignore[arg-type]  # of several types


class Lease:
    def __init__(self, epoch: int = 1, name: str = "a", other: str = "b") -> None:
        self.now = 50.0
        self.lease = ApplianceLease(name, other, "session", epoch, self.now)

    def later(self, seconds: float) -> "Lease":
        self.now += seconds
        return self

    def tick(self, *, waiting_since: float | None = None, caught_up: bool = False) -> Outgoing:
        return self.lease.tick(self.now, waiting_since=waiting_since, caught_up=caught_up)

    def requests(self, **state: Any) -> list[WitnessRequest]:
        return [one for one in self.tick(**state) if isinstance(one, WitnessRequest)]

    def operations(self, **state: Any) -> list[str]:
        return [request.operation for request in self.requests(**state)]

    def request(self, operation: str) -> WitnessRequest:
        (found,) = [request for request in self.requests() if request.operation == operation]
        return found

    def answered(self, request: WitnessRequest, **answer: object) -> Outgoing:
        return self.lease.answered(request, answer_of(**answer))

    def promised(self, asked: PromiseRequest, **answer: Any) -> None:
        self.lease.received(self.now, ClaimPromise(asked.epoch, asked.session, asked.number, **answer))

    def active(self) -> bool:
        return self.lease.is_active(self.now)


def active_lease() -> Lease:
    lease = Lease().later(EXPIRY)
    lease.answered(lease.request("claim"))
    assert lease.active()
    return lease


def asked_by(lease: Lease) -> PromiseRequest:
    return next(one for one in lease.tick() if isinstance(one, PromiseRequest))


def test_a_start_waits_one_expiry_before_it_claims() -> None:
    lease = Lease()
    assert lease.operations() == ["look"]
    assert lease.later(EXPIRY - 0.01).operations() == ["look"]
    assert lease.later(0.31).operations() == ["claim"]


def test_it_is_passive_after_0_8_of_an_expiry_without_renewal_or_promise() -> None:
    lease = active_lease()
    assert lease.later(CONFIDENCE - 0.01).active()
    assert lease.lease.next_event(lease.now) <= lease.now + 0.011
    assert not lease.later(0.02).active()


def test_a_renewal_counts_from_the_time_when_it_was_sent() -> None:
    lease = active_lease().later(0.5)
    renewal = lease.request("renew")
    lease.later(0.9)
    assert not lease.active()
    lease.answered(renewal)
    assert lease.active() and not lease.later(0.1).active()


def test_a_promise_alone_keeps_it_active() -> None:
    lease = active_lease()
    for number in range(20):
        asked = asked_by(lease.later(0.3))
        lease.promised(asked, unheard=0.3 * number)
        assert lease.active()
    lease.lease.received(lease.later(0.5).now, ClaimPromise(asked.epoch, "other", asked.number))
    assert not lease.later(CONFIDENCE - 0.49).active()


def test_a_holder_that_only_the_standby_could_replace_gives_up() -> None:
    lease, due = active_lease(), list[object]()
    while lease.active():
        due = list(lease.later(0.3).tick())
        for asked in due:
            if isinstance(asked, PromiseRequest):
                lease.promised(asked)
    assert not due
    assert EXPIRY < lease.now - 50.0 - EXPIRY < 1.5 * EXPIRY
    assert isinstance(lease.later(0.1).tick()[0], TakeOver)
    assert not lease.lease.may_be_renewed(lease.now)
    assert isinstance(lease.later(0.3).tick()[0], TakeOver)  # the first may be lost


def test_a_promise_ends_a_lapse_and_counts_from_its_request() -> None:
    lease = active_lease()
    asked = asked_by(lease.later(CONFIDENCE + 0.1))
    assert not lease.active()
    lease.later(0.5).promised(asked)
    assert lease.later(CONFIDENCE - 0.51).active()
    assert not lease.later(0.02).active()


def test_it_does_not_claim_while_its_promise_lasts() -> None:
    lease = Lease().later(EXPIRY)
    claim = lease.request("claim")
    (promise,) = lease.lease.received(lease.later(0.2).now, PromiseRequest(1, "theirs", 7))
    assert isinstance(promise, ClaimPromise)
    assert (promise.epoch, promise.session, promise.number) == (1, "theirs", 7)
    assert lease.later(0.3).operations() == ["look"]
    lease.answered(claim)
    assert not lease.active()
    renewal = lease.later(0.4).request("renew")
    lease.answered(renewal)
    assert not lease.active()
    assert lease.later(EXPIRY - 0.69).active()


def test_it_promises_nothing_after_the_lease_has_expired() -> None:
    lease, asked = Lease().later(EXPIRY), PromiseRequest(1, "theirs", 7)
    assert lease.lease.received(lease.now, asked)
    look = lease.request("look")
    lease.answered(look, epoch=1, holder="b", expired=True)
    assert not lease.lease.received(lease.later(0.3).now, asked)
    assert lease.later(EXPIRY).operations() == ["claim"]
    lease.answered(look, epoch=1, holder="b", expired=False)
    assert lease.lease.received(lease.now, asked)


def test_it_promises_nothing_to_an_older_epoch() -> None:
    lease = active_lease()
    assert list(lease.lease.received(lease.now, PromiseRequest(1, "theirs", 1))) == []
    assert lease.active()
    assert not lease.lease.follow(1) and not lease.lease.follow(2), "data of an older epoch, or of its own"
    lease.later(CONFIDENCE)
    assert list(lease.lease.received(lease.now, PromiseRequest(3, "theirs", 1))) != []
    assert not lease.active() and lease.lease.epoch == 3


@pytest.mark.parametrize("epoch", [3, 2 + FARTHEST, HIGHEST])
def test_an_active_appliance_believes_no_later_epoch(epoch: int) -> None:
    lease = active_lease()
    assert not lease.lease.received(lease.now, PromiseRequest(epoch, "theirs", 1))
    assert lease.active() and lease.lease.epoch == 2
    lease.answered(lease.later(0.3).request("renew"))
    assert lease.later(CONFIDENCE - 0.01).active()


def test_a_passive_appliance_believes_the_witness_more() -> None:
    lease = Lease(epoch=2)
    look = lease.request("look")
    assert lease.lease.follow(3) and not lease.lease.follow(2)
    lease.answered(look, holder="b")
    assert lease.lease.epoch == 3, "the answer may be older than the epoch"
    lease.answered(lease.later(0.3).request("look"), holder="b")
    assert lease.lease.epoch == 2 and lease.lease.follow(2)


def test_a_claimed_epoch_lets_no_restored_witness_in() -> None:
    lease = Lease(epoch=5)
    assert lease.lease.follow(6)
    lease.answered(lease.request("look"), epoch=4)
    assert lease.lease.epoch == 5


def test_an_epoch_that_jumps_is_not_believed() -> None:
    lease = Lease(epoch=7)
    assert not lease.lease.follow(8 + FARTHEST)
    assert lease.lease.follow(7 + FARTHEST)
    lease = Lease(epoch=7)
    lease.answered(lease.request("look"), epoch=8 + FARTHEST, holder="b")
    assert lease.lease.epoch == 7 and "rosrv standby repair" in lease.lease.refusal
    repaired = Lease(epoch=0)
    repaired.answered(repaired.request("look"), epoch=8 + FARTHEST, holder="b")
    assert repaired.lease.epoch == 8 + FARTHEST


def test_a_refused_renewal_of_a_replaced_holder_ends_its_epoch() -> None:
    lease = active_lease().later(0.3)
    lease.answered(lease.request("renew"), ok=False, reason="b holds epoch 3", epoch=3, holder="b")
    assert not lease.active() and lease.lease.refusal == ""
    assert lease.later(0.3).operations() == ["claim"]


def test_a_grant_whose_answer_was_lost_is_claimed_again() -> None:
    lease = active_lease().later(0.3)
    lease.answered(lease.request("renew"), ok=False, reason="a holds epoch 3", epoch=3)
    assert (lease.lease.epoch, lease.lease.held) == (3, None)
    assert lease.later(0.3).operations() == ["claim"]


@pytest.mark.parametrize("granted", [True, False])
def test_a_smaller_epoch_of_the_witness_is_never_taken(granted: bool) -> None:
    lease = Lease(epoch=9).later(EXPIRY)
    for _ in range(3):
        lease.answered(lease.later(0.3).request("claim"), ok=granted, holder="a" if granted else "", epoch=6)
    assert not lease.active() and lease.lease.epoch == 9


def test_it_answers_alone_only_after_the_removal() -> None:
    lease = active_lease()
    now = lease.later(0.3).now
    assert lease.operations(waiting_since=now) == ["renew"]
    renewal, removal = lease.later(0.61).requests(waiting_since=now)
    assert removal.operation == "remove"
    lease.answered(renewal)
    assert lease.lease.is_active(lease.now) and not lease.lease.answers_alone
    lease.answered(removal, in_sync=ALONE)
    assert lease.lease.is_active(lease.now) and lease.lease.answers_alone


def test_a_change_that_waits_too_long_does_not_wait_for_the_next_round() -> None:
    lease = active_lease()
    assert lease.later(0.3).operations(waiting_since=0.0) == ["renew", "remove"]
    assert lease.later(0.1).operations(waiting_since=0.0) == []
    assert lease.later(0.2).operations(waiting_since=0.0) == ["renew", "remove"]
    assert lease.later(0.05).operations() == []
    lease.answered(lease.later(0.25).request("renew"), in_sync=ALONE)
    assert lease.later(0.1).operations(waiting_since=0.0) == []
    assert lease.lease.is_active(lease.now) and lease.lease.answers_alone


def test_a_change_that_waits_is_noticed_between_two_rounds() -> None:
    lease = active_lease().later(0.3)
    assert lease.operations(waiting_since=lease.now) == ["renew"]
    assert lease.later(0.1).operations(waiting_since=0.0) == ["remove"]
    assert Lease().later(EXPIRY + 0.1).operations(waiting_since=0.0) == ["claim"], "only while active"


def test_it_claims_when_its_promise_ends_and_ten_times_a_second() -> None:
    lease = Lease().later(EXPIRY)
    lease.lease.received(lease.now, PromiseRequest(1, "theirs", 7))
    end = lease.now + EXPIRY
    while lease.operations() == ["look"]:
        lease.now = lease.lease.next_event(lease.now)
    assert lease.now == pytest.approx(end)
    lease.now = lease.lease.next_event(lease.now)
    assert lease.now == pytest.approx(end + 0.1) and lease.operations() == ["claim"]


def test_it_waits_for_the_standby_before_it_is_added() -> None:
    lease = active_lease().later(0.3)
    old = lease.request("renew")
    lease.answered(old, in_sync=ALONE)
    assert lease.lease.is_active(lease.now) and lease.lease.answers_alone
    assert lease.later(0.3).operations(caught_up=False) == ["renew"]
    assert lease.lease.is_active(lease.now) and lease.lease.answers_alone
    assert lease.later(0.3).operations(caught_up=True) == ["renew", "add"]
    lease.answered(old, in_sync=ALONE)
    assert not (lease.lease.is_active(lease.now) and lease.lease.answers_alone)
    lease.answered(lease.later(0.3).request("renew"), in_sync=ALONE)
    assert lease.lease.is_active(lease.now) and lease.lease.answers_alone, "the addition was lost"


def in_a_switchover() -> tuple[Lease, TakeOver]:
    lease = active_lease()
    lease.promised(asked_by(lease.later(0.3)))
    (release,) = lease.lease.switch_over(lease.now)
    assert isinstance(release, WitnessRequest) and release.operation == "release"
    assert not lease.active()
    assert lease.answered(release) == ()  # the other processes hear of it before the other appliance does
    (order,) = lease.later(0.1).tick()
    assert isinstance(order, TakeOver)
    return lease, order


def test_a_switchover_ends_the_promises_to_the_old_holder() -> None:
    _, order = in_a_switchover()
    standby = Lease().later(EXPIRY)
    standby.lease.received(standby.now, PromiseRequest(order.epoch, order.session, order.number))
    assert standby.later(0.1).operations() == ["look"]
    (claim,) = standby.lease.received(standby.now, order)
    assert isinstance(claim, WitnessRequest) and claim.operation == "claim"


@pytest.mark.parametrize("requests", [[1], [1, 0]])
def test_a_late_order_ends_no_later_promise_whatever_request_comes_late(requests: list[int]) -> None:
    _, order = in_a_switchover()
    standby = Lease().later(EXPIRY)
    for later in requests:
        request = PromiseRequest(order.epoch, order.session, order.number + later)
        standby.lease.received(standby.now, request)
    assert list(standby.lease.received(standby.now, order)) == []
    assert standby.later(0.3).operations() == ["look"]


def test_older_answers_do_not_undo_a_switchover() -> None:
    lease = active_lease().later(0.3)
    renewal, asked = lease.tick()
    assert isinstance(renewal, WitnessRequest) and isinstance(asked, PromiseRequest)
    promise = ClaimPromise(asked.epoch, asked.session, asked.number)
    lease.lease.received(lease.now, promise)
    lease.lease.switch_over(lease.now)
    lease.answered(renewal)
    lease.lease.received(lease.now, promise)
    assert not lease.active()
    assert lease.later(0.3).operations() == ["release"]
    lease.answered(lease.later(2 * EXPIRY).request("renew"))
    assert lease.active()


def test_an_impossible_switchover_is_refused_with_the_reason() -> None:
    with pytest.raises(LeaseError, match="not active; give the order to the other one"):
        Lease().lease.switch_over(50.0)
    lease = active_lease()
    with pytest.raises(LeaseError, match="b is not ready to take over"):
        lease.lease.switch_over(lease.now)
    assert lease.active()


@pytest.mark.parametrize(
    ("able", "silence", "trouble", "reason"),
    [
        (True, 0.3, "", ""),
        (False, 0.3, "", "b could not serve after a takeover"),
        (True, EXPIRY + 0.4, "", "the witness on the robot does not answer b"),
        (True, 0.3, "the disk is full", "could not grant the takeover: the disk is full"),
    ],
)
def test_a_lease_is_given_up_only_to_an_appliance_that_could_claim_it(
    able: bool, silence: float, trouble: str, reason: str
) -> None:
    standby = Lease().later(EXPIRY)
    standby.answered(standby.request("claim"), ok=False, holder="a")
    standby.lease.ready = able
    lease = active_lease()
    lease.answered(lease.later(0.3).request("renew"), trouble=trouble)
    asked = asked_by(lease.later(0.3))
    for promise in standby.lease.received(standby.later(silence).now, asked):
        lease.lease.received(lease.now, promise)  # type: ignore[arg-type]  # a promise
    assert reason in lease.lease.handover_obstacle(lease.now)
    if reason:
        with pytest.raises(LeaseError, match=reason):
            lease.lease.switch_over(lease.now)
    else:
        lease.lease.switch_over(lease.now)
    assert lease.active() == bool(reason)


OLDER: dict[str, Any] = {
    "ok": False, "reason": "the witness knows only epoch 1", "epoch": 1, "holder": "b", "in_sync": ALONE,
}  # fmt: skip


def test_a_witness_with_an_older_lease_makes_no_switchover_possible() -> None:
    """It admits neither appliance, so an appliance that gave its lease up could not get it back."""
    lease = active_lease()
    lease.answered(lease.later(0.3).request("renew"))
    lease.promised(asked_by(lease.later(0.3)))
    assert lease.lease.handover_obstacle(lease.now) == ""
    seen = lease.lease.seen
    lease.answered(lease.later(0.3).request("renew"), **OLDER)
    obstacle = lease.lease.takeover_obstacle(lease.now)
    assert obstacle == "the witness on the robot refuses this appliance: the witness knows only epoch 1"
    with pytest.raises(LeaseError, match="knows only epoch 1"):
        lease.lease.switch_over(lease.now)
    assert lease.active()
    assert lease.lease.seen == seen, "the holder and the set of an older lease are not those of this pair"
    lease.answered(lease.later(0.3).request("renew"))
    assert "refuses" not in lease.lease.takeover_obstacle(lease.now)


@pytest.mark.parametrize(
    ("answer", "silence", "obstacle"),
    [
        ({"ok": False, "holder": "a"}, 0.3, ""),
        (OLDER, 0.3, "the witness on the robot refuses this appliance: the witness knows only epoch 1"),
        ({"ok": False, "holder": "a", "in_sync": ALONE}, 0.3, "b lacks changes that a has acknowledged"),
        ({"ok": False, "holder": "a", "trouble": "full"}, 0.3,
         "the witness on the robot could not grant the takeover: full"),
        ({"ok": False, "holder": "a"}, EXPIRY + 0.1, "the witness on the robot does not answer this appliance"),
    ],
)  # fmt: skip
def test_a_standby_knows_why_it_could_not_claim(
    answer: dict[str, object], silence: float, obstacle: str
) -> None:
    standby = Lease(epoch=2, name="b", other="a")
    assert "does not answer" in standby.lease.takeover_obstacle(standby.now)
    standby.answered(standby.later(EXPIRY).request("claim"), **answer)
    found = standby.lease.takeover_obstacle(standby.later(silence).now)
    assert found.startswith(obstacle) and bool(found) == bool(obstacle)


@pytest.mark.parametrize(
    ("answer", "reported"),
    [
        ({"reason": "a holds the lease for another 0.9 s"}, False),
        ({"reason": "b is not in sync", "expired": True, "in_sync": ALONE}, False),
        (OLDER, True),
    ],
)
def test_a_claim_that_came_too_early_is_not_a_refusal(answer: dict[str, Any], reported: bool) -> None:
    """A standby claims again and again while it does not hear the active appliance."""
    standby = Lease(epoch=2, name="b", other="a")
    claim = standby.later(EXPIRY).request("claim")
    standby.answered(claim, **({"ok": False, "holder": "a"} | answer))
    assert standby.lease.refusal == (answer["reason"] if reported else "")


def test_a_standby_that_the_witness_refuses_does_not_count_as_answered() -> None:
    standby = Lease(epoch=2)
    for _ in range(6):
        standby.answered(standby.later(0.3).requests()[0], **OLDER)
    (promise,) = standby.lease.received(standby.now, PromiseRequest(2, "other", 1))
    assert isinstance(promise, ClaimPromise) and promise.unheard > EXPIRY


# ---- Both appliances and the witness


class Pair:
    def __init__(self) -> None:
        self.now = 50.0
        self.robot = Robot()
        self.leases = {
            name: ApplianceLease(name, other, name, 1, self.now) for name, other in (("a", "b"), ("b", "a"))
        }
        self.channels = {name: WitnessChannel(name, KEYS[name], name) for name in self.leases}

    def run(self, seconds: float) -> "Pair":
        end = self.now + seconds
        while self.now < end:
            self.now += 0.1
            self.robot.now += 0.1
            for name, lease in self.leases.items():
                self.deliver(name, lease.tick(self.now, waiting_since=None, caught_up=False))
        return self

    def deliver(self, name: str, due: Outgoing) -> None:
        for message in due:
            if isinstance(message, WitnessRequest):
                datagram = self.robot.gate.answer(self.channels[name].write(message), PEERS[name].address)
                found = self.channels[name].read(datagram) if datagram is not None else None
                if found is not None:
                    self.deliver(name, self.leases[name].answered(*found))
            else:
                other = "b" if name == "a" else "a"
                self.deliver(other, self.leases[other].received(self.now, message))

    def active(self) -> list[str]:
        return [name for name, lease in self.leases.items() if lease.is_active(self.now)]

    def refusals(self) -> list[str]:
        return [lease.refusal for lease in self.leases.values()]


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (LeaseRecord(1, "a", ("a", "b"), "one"), "the witness knows only epoch 1: run witness.py begin"),
        (LeaseRecord(1, "b", ("a", "b"), "one"), "the witness knows only epoch 1: run witness.py begin"),
        (None, "the lease is damaged: run witness.py begin"),
    ],
)
def test_a_witness_that_grants_nothing_is_reported_and_ends_no_service(
    record: LeaseRecord | None, reason: str
) -> None:
    pair = Pair().run(5)
    assert pair.active() == ["a"] and pair.refusals() == ["", ""]
    pair.robot = Robot(record, boot="two")
    pair.run(3)
    assert pair.active() == ["a"], "hosts in tunnels are still served"
    assert all(reason in refusal for refusal in pair.refusals())
    with pytest.raises(LeaseError, match=reason):
        pair.leases["a"].switch_over(pair.now)
    pair.now += 10
    assert pair.active() == []
    pair.run(0.5)
    assert pair.active() == ["a"], "it comes back after a lapse"
    pair.robot = Robot(FIRST._replace(epoch=9))
    pair.run(5)
    assert len(pair.active()) == 1 and pair.refusals() == ["", ""]
    assert pair.leases["a"].epoch == 10


def test_after_a_failed_switchover_the_appliance_comes_back() -> None:
    pair = Pair().run(5)
    pair.robot = Robot(FIRST, boot="two")
    pair.deliver("a", pair.leases["a"].switch_over(pair.now))
    assert pair.run(1).active() == []
    assert pair.run(2).active() == ["a"]


# ---- The datagrams


def exchanged(channel: WitnessChannel, robot: Robot, request: WitnessRequest) -> WitnessAnswer | None:
    datagram = robot.gate.answer(channel.write(request), "10.0.0.2")
    assert datagram is not None
    found = channel.read(datagram)
    return None if found is None else found[1]


def test_a_new_appliance_learns_nonce_and_number() -> None:
    robot, claim = Robot().expired(), WitnessRequest("claim", 1, 1, 0.0)
    for session in ("one", "two"):
        channel = WitnessChannel("a", KEYS["a"], session)
        assert exchanged(channel, robot, claim) is None
        assert exchanged(channel, robot, claim) is not None
    assert robot.disk is not None and robot.disk.holder == "a"


def test_a_recorded_or_forged_answer_counts_for_nothing() -> None:
    robot, claim = Robot().expired(), WitnessRequest("claim", 1, 1, 0.0)
    channel, restarted = WitnessChannel("a", KEYS["a"], "one"), WitnessChannel("a", KEYS["a"], "two")
    exchanged(channel, robot, claim)
    datagram = robot.gate.answer(channel.write(claim), "10.0.0.2")
    assert datagram is not None
    restarted.write(claim)
    restarted.write(claim)
    for wrong in (b"", datagram[:20], datagram[:-1] + b" ", datagram + b"\0"):
        assert channel.read(wrong) is None
    assert restarted.read(datagram) is None
    assert channel.read(datagram) is not None
    assert channel.read(datagram) is None


def test_an_appliance_that_could_not_serve_does_not_claim() -> None:
    lease = Lease().later(EXPIRY)
    lease.lease.ready = False
    assert lease.operations() == ["look"]
    lease.lease.ready = True
    assert lease.later(1.0).operations() == ["claim"]


@pytest.mark.parametrize(
    "folder", ["/var/lib/rosrv", "/srv/" + "rechner/" * 40, "/srv/" + "ロボット/" * 60, '/"' * 200]
)
def test_the_standby_hears_why_the_lease_is_kept(folder: str) -> None:
    """However long the reason is, its datagram is not too long to be read, and its end arrives."""
    lease, there = active_lease(), Lease()
    lease.lease.fault = f"{folder}/audit.db: the disk is full; it keeps the lease: b is not ready"
    asked = PeerChannel("b", "a", KEYS["b"]).read(
        PeerChannel("a", "b", KEYS["b"]).write(asked_by(lease.later(0.3)))
    )
    assert isinstance(asked, PromiseRequest)
    there.lease.received(there.now, asked)
    told = there.lease.active_fault(there.now)
    assert (told[:5], told.endswith("it keeps the lease: b is not ready")) == (folder[:5], True)
