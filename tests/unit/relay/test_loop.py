import itertools
import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from appliance.relay.loop import ACCEPTING, QUANTUM, READ, SYSTEM, UNKNOWN, EventLoop


@pytest.fixture
def loop() -> Iterator[EventLoop]:
    loop = EventLoop()
    yield loop
    loop.close()


@pytest.mark.nightly
def test_a_handler_is_not_called_for_what_was_discarded_in_the_same_turn(loop: EventLoop) -> None:
    pairs = [socket.socketpair() for _ in range(2)]
    called = []
    for index in range(2):

        def handle(_events: int, index: int = index) -> None:
            called.append(index)
            loop.discard(pairs[1 - index][0])

        loop.watch(pairs[index][0].fileno(), READ, handle)
        pairs[index][1].send(b"x")
    loop.turn(1)
    assert len(called) == 1
    assert pairs[1 - called[0]][0].fileno() == -1
    for pair in pairs:
        for sock in pair:
            sock.close()


def test_timers_run_in_order_and_cancelled_ones_never(loop: EventLoop) -> None:
    now = 0.0
    loop.clock = lambda: now
    ran: list[str] = []
    loop.after(2, lambda: ran.append("second"))
    loop.after(1, lambda: ran.append("first"))
    loop.after(2, lambda: ran.append("third"))
    loop.after(1, lambda: ran.append("never")).cancel()
    now = 1.5
    loop.turn(0)
    assert ran == ["first"]
    now = 3
    loop.turn(0)
    assert ran == ["first", "second", "third"]


def test_stop_ends_run_after_the_turn(loop: EventLoop) -> None:
    loop.after(0, loop.stop)
    loop.run()


class Costs:
    def __init__(self) -> None:
        self.used = 0
        self.loop = EventLoop(lambda: self.used)
        self.order: list[str] = []
        self.waits: list[float] = []
        self._open: list[socket.socket] = []

    def ready(self, payer: str, cost: int, times: float = float("inf")) -> socket.socket:
        ours, theirs = socket.socketpair()
        self._open += (ours, theirs)
        theirs.send(b"x")
        left = times

        def handle(_events: int) -> None:
            nonlocal left
            self.used += cost
            self.order.append(payer)
            self.waits.append(self.loop.waited)
            left -= 1
            if left <= 0:
                self.loop.unwatch(ours.fileno())

        self.loop.watch(ours.fileno(), READ, handle, payer)
        return ours

    def turns_until(self, condition: Callable[[], object]) -> int:
        for turns in range(1000):
            if condition():
                return turns
            self.loop.turn(0)
        raise AssertionError(f"not within 1000 turns: {self.order[-20:]}")

    def close(self) -> None:
        self.loop.close()
        for sock in self._open:
            sock.close()


@pytest.fixture
def costs() -> Iterator[Costs]:
    costs = Costs()
    yield costs
    costs.close()


@pytest.mark.nightly
def test_a_host_with_little_to_do_waits_for_one_quantum_of_others(costs: Costs) -> None:
    costs.ready("robot", QUANTUM // 50, 1)
    costs.turns_until(lambda: costs.order)
    for number in range(200):
        costs.ready(f"10.9.0.{number}", QUANTUM)
    costs.turns_until(lambda: len(costs.order) > 300)
    for _ in range(20):
        before = len(costs.order)
        costs.ready("robot", QUANTUM // 50, 1)
        costs.turns_until(lambda: "robot" in costs.order[before:])  # noqa: B023  it is called here
        assert costs.order[before:].index("robot") <= 2
        costs.turns_until(lambda: len(costs.order) >= before + 10)  # noqa: B023  as above


@pytest.mark.nightly
def test_many_new_hosts_do_not_come_before_one_that_used_little(costs: Costs) -> None:
    costs.ready("robot", QUANTUM // 50, 1)
    costs.turns_until(lambda: costs.order)
    costs.ready("guest", QUANTUM)
    costs.ready("other", QUANTUM)
    costs.turns_until(lambda: len(costs.order) > 20)
    for number in range(200):
        costs.ready(f"10.9.0.{number}", 10 * QUANTUM, 1)
    for _ in range(10):
        before = len(costs.order)
        costs.ready("robot", QUANTUM // 50, 1)
        costs.turns_until(lambda: "robot" in costs.order[before:])  # noqa: B023  it is called here
        assert costs.order[before:].index("robot") <= 2


@pytest.mark.nightly
def test_a_host_with_thousands_of_descriptors_gets_no_more_than_one_with_one(costs: Costs) -> None:
    for _ in range(400):
        costs.ready("guest", QUANTUM // 10)
    costs.ready("robot", QUANTUM // 10)
    costs.turns_until(lambda: len(costs.order) >= 1000)
    assert 450 <= costs.order.count("robot") <= 550


@pytest.mark.nightly
def test_each_descriptor_of_a_host_has_its_turn(costs: Costs) -> None:
    costs.ready("guest", 2 * QUANTUM)
    later = costs.ready("guest", 1, 1)
    costs.ready("robot", QUANTUM)
    costs.turns_until(lambda: costs.order.count("guest") > 4)
    with pytest.raises(KeyError):
        costs.loop.change(later.fileno(), READ)  # the handler was served, and unwatched itself


@pytest.mark.nightly
@pytest.mark.parametrize("others", [3, 200])
def test_the_wait_of_a_descriptor_counts_from_its_first_report(costs: Costs, others: int) -> None:
    """Each handler takes a quantum, a millisecond: the last of a host's descriptors waits for all others."""
    costs.loop.clock = lambda: costs.used / 1e9
    for _ in range(others + 1):
        costs.ready("guest", QUANTUM, 1)
    costs.turns_until(lambda: len(costs.waits) > others)
    assert max(costs.waits) == pytest.approx(others * QUANTUM / 1e9, rel=0.05)
    assert costs.loop.take_longest() >= QUANTUM / 1e9 and costs.loop.take_longest() == 0


@pytest.mark.nightly
def test_all_unknown_hosts_together_are_one_payer(costs: Costs) -> None:
    for _ in range(200):
        costs.ready(UNKNOWN, QUANTUM)
    costs.ready(ACCEPTING, QUANTUM)
    costs.ready("robot", QUANTUM)
    costs.turns_until(lambda: len(costs.order) >= 300)
    assert {payer: round(costs.order.count(payer), -1) for payer in ("robot", ACCEPTING)} == {
        "robot": 100,
        ACCEPTING: 100,
    }


@pytest.mark.nightly
def test_a_host_that_overdraws_waits_for_the_others(costs: Costs) -> None:
    costs.ready("guest", 20 * QUANTUM)
    costs.ready("robot", QUANTUM)
    costs.turns_until(lambda: costs.order.count("guest") == 3)
    assert 38 <= costs.order.count("robot") <= 42


@pytest.mark.nightly
def test_costly_messages_of_many_hosts_never_come_in_a_row(costs: Costs) -> None:
    for number in range(200):
        costs.ready(f"10.9.0.{number}", 10 * QUANTUM)
    costs.turns_until(lambda: len(costs.order) >= 200)
    costs.ready("robot", QUANTUM)
    costs.turns_until(lambda: "robot" in costs.order)
    costs.order.clear()
    costs.turns_until(lambda: len(costs.order) >= 300)
    guests = "".join("r" if payer == "robot" else "g" for payer in costs.order)
    assert "ggg" not in guests


@pytest.mark.nightly
def test_hosts_within_their_quantum_do_not_starve_a_costly_one(costs: Costs) -> None:
    costs.ready("camera", 10 * QUANTUM)
    for number in range(9):
        costs.ready(f"10.9.0.{number}", QUANTUM)
    costs.turns_until(lambda: costs.order.count("camera") >= 10)
    assert 90 <= costs.order.count("10.9.0.0") <= 110


@pytest.mark.nightly
def test_control_and_lifeline_are_served_in_every_turn(costs: Costs) -> None:
    for number in range(100):
        costs.ready(f"10.9.0.{number}", 2 * QUANTUM)
    costs.ready(SYSTEM, 1)
    for _ in range(3):
        costs.loop.turn(0)  # more are ready than the first query returns
    costs.order.clear()
    costs.turns_until(lambda: len(costs.order) >= 40)
    served = [place for place, payer in enumerate(costs.order) if payer == SYSTEM]
    assert max(after - before for before, after in itertools.pairwise(served)) <= 2


@pytest.mark.nightly
def test_a_host_alone_is_served_without_waiting_and_owes_nothing(costs: Costs) -> None:
    costs.ready("guest", 5 * QUANTUM)
    costs.turns_until(lambda: len(costs.order) >= 50)
    costs.ready("robot", QUANTUM)
    costs.turns_until(lambda: costs.order.count("guest") >= 54)
    assert costs.order.count("robot") <= 30


@pytest.mark.nightly
def test_postponed_work_takes_turns_with_events_and_other_hosts(costs: Costs) -> None:
    def work() -> None:
        costs.used += QUANTUM
        costs.order.append("left")
        costs.loop.later(work, "guest")

    costs.loop.later(work, "guest")
    costs.ready("guest", QUANTUM)
    costs.ready("robot", QUANTUM)
    costs.turns_until(lambda: len(costs.order) >= 200)
    shares = {name: costs.order.count(name) for name in ("left", "guest", "robot")}
    assert 90 <= shares["robot"] <= 110
    assert 40 <= shares["left"] <= 60


@pytest.mark.nightly
def test_a_charge_for_a_new_connection_delays_its_host(costs: Costs) -> None:
    costs.ready("guest", QUANTUM)
    costs.ready("robot", QUANTUM)
    costs.loop.turn(0)
    costs.loop.charge("guest", 30 * QUANTUM)
    costs.order.clear()
    costs.turns_until(lambda: "guest" in costs.order)
    assert costs.order.count("robot") >= 29


@pytest.mark.nightly
def test_connections_made_while_alone_leave_no_debt(costs: Costs) -> None:
    def accept(_events: int) -> None:
        costs.used += 50_000
        costs.loop.charge("robot", 50_000)

    ours, theirs = socket.socketpair()
    costs.loop.watch(ours.fileno(), READ, accept, ACCEPTING)
    theirs.send(b"x")
    for _ in range(1000):
        costs.loop.turn(0)
    costs.loop.discard(ours)
    theirs.close()
    costs.ready("guest", QUANTUM)
    costs.ready("robot", QUANTUM, times=1)
    costs.turns_until(lambda: "robot" in costs.order)
    assert costs.order.count("guest") <= 2


@pytest.mark.nightly
def test_timers_that_are_due_together_are_called_a_quantum_at_a_time(costs: Costs) -> None:
    called: list[None] = []

    def call() -> None:
        costs.used += QUANTUM // 4
        called.append(None)

    for _ in range(10_000):
        costs.loop.after(0, call)
    costs.ready("robot", 1)
    costs.turns_until(lambda: len(costs.order) >= 10)
    assert len(called) <= 60


@pytest.mark.nightly
def test_work_beside_the_loop_is_done_in_a_thread_and_ends_in_the_loop(loop: EventLoop) -> None:
    may_end = threading.Event()
    results: list[tuple[int, int]] = []

    def work() -> int:
        may_end.wait(30)
        return threading.get_ident()

    loop.beside(work, lambda worker: results.append((worker, threading.get_ident())))
    loop.turn(0)
    assert results == []
    may_end.set()
    loop.turn(30)
    [(worker, caller)] = results
    assert caller == threading.get_ident() != worker


@pytest.mark.nightly
def test_discarded_work_is_not_reported(loop: EventLoop) -> None:
    results: list[None] = []
    before = threading.active_count()
    loop.beside(lambda: None, results.append).discard()
    loop.turn(0)
    assert (results, threading.active_count()) == ([], before)
