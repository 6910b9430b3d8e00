import asyncio
import ipaddress
from collections.abc import Callable
from functools import partial

import pytest

from appliance.policy.model import Address
from appliance.rpc.processor_time import TURN_SECONDS, HostTask, Line, ProcessorTime

pytestmark = pytest.mark.anyio

ROBOT, GUEST = ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.66")
UNKNOWN = [ipaddress.ip_address(f"10.9.0.{number}") for number in range(200)]
PIECE = TURN_SECONDS / 4


class Loop:
    def __init__(self) -> None:
        self.now = 0.0
        self.order: list[Address] = []
        self.turns: list[float] = []
        self.time = ProcessorTime(lambda host: "unknown" if host in UNKNOWN else host, lambda: self.now)

    def work(self, host: Address, seconds: float = PIECE) -> Callable[[], None]:
        def run() -> None:
            self.order.append(host)
            self.now += seconds

        return run

    async def all(self) -> None:
        while self.time.waiting:
            before = self.now
            await asyncio.sleep(0)
            self.turns.append(self.now - before)


@pytest.fixture
def loop() -> Loop:
    return Loop()


async def test_a_turn_of_the_loop_is_bounded(loop: Loop) -> None:
    ran = [loop.time.run(GUEST, loop.work(GUEST)) for _ in range(500)]
    assert sum(ran) == 4
    await loop.all()
    assert len(loop.order) == 500
    assert max(loop.turns) <= TURN_SECONDS + PIECE


async def test_the_robot_waits_for_one_piece_of_a_flood(loop: Loop) -> None:
    for _ in range(500):
        loop.time.run(GUEST, loop.work(GUEST))
    loop.time.run(ROBOT, loop.work(ROBOT))
    await loop.all()
    assert loop.order.index(ROBOT) <= 5


async def test_a_robot_that_worked_alone_owes_nothing(loop: Loop) -> None:
    for _ in range(1000):
        assert loop.time.run(ROBOT, loop.work(ROBOT))
        await asyncio.sleep(0)
    loop.order.clear()
    for _ in range(500):
        loop.time.run(GUEST, loop.work(GUEST))
    loop.time.run(ROBOT, loop.work(ROBOT))
    await loop.all()
    assert loop.order.index(ROBOT) <= 5


async def test_a_debt_stays_while_others_wait(loop: Loop) -> None:
    for host in (GUEST, ROBOT) * 50:
        loop.time.run(host, loop.work(host, 20 * PIECE if not loop.order else PIECE))
    await loop.all()
    assert loop.order[1:20].count(ROBOT) >= 18


async def test_two_hundred_unknown_hosts_are_one(loop: Loop) -> None:
    for host in UNKNOWN * 2:
        loop.time.run(host, loop.work(host))
    for _ in range(100):
        loop.time.run(ROBOT, loop.work(ROBOT))
    await loop.all()
    while_the_robot_had_work = loop.order[: len(loop.order) - loop.order[::-1].index(ROBOT)]
    assert sum(host in UNKNOWN for host in while_the_robot_had_work) <= 100 + 6
    assert len(set(loop.order[:210]) & set(UNKNOWN)) >= 90, "one unknown host had the others' turns"


@pytest.mark.parametrize("factor", [0.1, 10.0])
async def test_time_counts_and_not_the_number_of_requests(factor: float, loop: Loop) -> None:
    for _ in range(2000):
        loop.time.run(GUEST, loop.work(GUEST, PIECE))
        loop.time.run(ROBOT, loop.work(ROBOT, PIECE * factor))
    while all(loop.order.count(host) < 2000 for host in (GUEST, ROBOT)):
        await asyncio.sleep(0)
    used = {GUEST: loop.order.count(GUEST) * PIECE, ROBOT: loop.order.count(ROBOT) * PIECE * factor}
    assert abs(used[GUEST] - used[ROBOT]) <= 3 * PIECE * max(factor, 1.0) + TURN_SECONDS


def test_no_host_saves_time_and_debts_stay() -> None:
    line: Line[str, int] = Line()
    for number in range(100):
        line.put("guest", number)
        assert line.pop() == ("guest", number)
        line.charge("guest", 1.0)
    line.charge("robot", 5.0)
    for number in range(8):
        line.put("guest", number)
        line.put("robot", number)
    order = []
    for _ in range(8):
        order.append(line.pop()[0])
        line.charge(order[-1], 1.0)
    assert 4 <= order.count("guest") <= 6
    assert order[0] == "guest"


def test_a_charge_costs_the_same_for_any_number_of_hosts() -> None:
    """In a flood each host has a new address, so all of them have debts."""
    looked_at = 0

    class Host(int):
        def __hash__(self) -> int:
            nonlocal looked_at
            looked_at += 1
            return int(self)

    line: Line[Host, None] = Line()
    debtor, waiting = Host(1), Host(0)
    line.put(waiting, None)
    line.charge(debtor, 60.0)
    for number in range(2, 5000):
        line.charge(Host(number), 1.0)
    assert looked_at < 10 * 5000
    assert line.time_used(debtor) == 60.0, "a debt of one host was forgotten for the small ones of many"


async def test_steps_of_coroutines_are_charged_and_wait(loop: Loop) -> None:
    async def handler(host: Address, pieces: int) -> Address:
        for _ in range(pieces):
            loop.work(host)()
            await asyncio.sleep(0)
        return host

    guests = [HostTask(loop.time, GUEST, handler(GUEST, 50)) for _ in range(20)]
    await asyncio.sleep(0)
    begun = len(loop.order)
    assert await HostTask(loop.time, ROBOT, handler(ROBOT, 10)) == ROBOT
    between = loop.order[begun:]
    assert between.count(GUEST) <= 4 * 10, (
        "more than a turn of the guests' steps for each step of the robot's"
    )
    assert await asyncio.gather(*guests) == [GUEST] * 20
    assert (loop.time.waiting, loop.order.count(GUEST)) == (0, 1000)


async def test_cancelled_and_failed_work_takes_no_turn_of_others(loop: Loop) -> None:
    ended: list[int] = []

    async def handler(number: int) -> int:
        try:
            for _ in range(5):
                loop.work(GUEST)()
                await asyncio.sleep(0)
            if number % 5 == 0:
                raise ValueError(number)
        finally:
            ended.append(number)
        return number

    tasks = [HostTask(loop.time, GUEST, handler(number)) for number in range(50)]
    for _ in range(20):
        await asyncio.sleep(0)
    begun = set(ended)
    for task in tasks[::3]:
        task.cancel()
        await asyncio.sleep(0)
    done = await asyncio.gather(*tasks, return_exceptions=True)
    for number, outcome in enumerate(done):
        if number % 3 == 0 and number not in begun:
            assert isinstance(outcome, asyncio.CancelledError)
        elif number % 5 == 0:
            assert isinstance(outcome, ValueError)
        else:
            assert outcome == number
    assert loop.time.waiting == 0
    assert loop.time.run(ROBOT, loop.work(ROBOT)) or loop.time.waiting


async def test_a_defect_in_work_is_reported_and_stops_no_other(loop: Loop) -> None:
    reports: list[str] = []
    asyncio.get_running_loop().set_exception_handler(
        lambda _loop, context: reports.append(context["message"])
    )

    def defect() -> None:
        loop.work(GUEST, TURN_SECONDS)()
        raise RuntimeError("defect")

    loop.time.run(GUEST, defect)
    loop.time.run(GUEST, defect)
    loop.time.run(ROBOT, loop.work(ROBOT))
    await loop.all()
    assert (len(reports), loop.order.count(ROBOT)) == (2, 1)


@pytest.fixture
def time() -> ProcessorTime:
    return ProcessorTime(lambda host: host, lambda: 0.0)


async def test_work_that_waits_for_nothing_ends_at_once(time: ProcessorTime) -> None:
    async def work() -> str:
        return "done"

    assert HostTask(time, ROBOT, work()).result() == "done"
    time.charge(GUEST, TURN_SECONDS)
    made: list[HostTask[str]] = []
    time.run(GUEST, lambda: made.append(HostTask(time, GUEST, work())))
    time.run(ROBOT, lambda: None)
    waiting = HostTask(time, ROBOT, work())
    assert not made
    assert not waiting.done()
    assert await waiting == "done"
    assert made[0].result() == "done"


async def test_a_task_is_the_current_one_in_its_steps(time: ProcessorTime) -> None:
    seen: list[object] = []

    async def inner() -> None:
        seen.append(asyncio.current_task())
        await asyncio.sleep(0)
        seen.append(asyncio.current_task())

    async def outer() -> None:
        made.append(HostTask(time, ROBOT, inner()))
        seen.append(asyncio.current_task())
        await made[0]

    made: list[HostTask[None]] = []
    task = HostTask(time, ROBOT, outer())
    assert id(task) in map(id, asyncio.all_tasks())
    await task
    assert seen == [made[0], task, made[0]]
    assert id(task) not in map(id, asyncio.all_tasks())


async def test_a_limit_of_time_ends_a_wait(time: ProcessorTime) -> None:
    async def work() -> str:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.001):
                await asyncio.Event().wait()
        await asyncio.sleep(0)
        return "went on"

    assert await HostTask(time, ROBOT, work()) == "went on"


@pytest.mark.parametrize("busy", [False, True], ids=["waiting", "its step is due"])
async def test_a_cancelled_task_ends(busy: bool, time: ProcessorTime) -> None:
    ready, ended = asyncio.Event(), list[str]()

    async def work() -> None:
        try:
            await ready.wait()
            ended.append("ran")
        except asyncio.CancelledError:
            ended.append("cancelled")
            raise

    task = HostTask(time, ROBOT, work())
    await asyncio.sleep(0)  # the next turn begins
    if busy:
        ready.set()
        asyncio.get_running_loop().call_soon(task.cancel)
        time.charge(GUEST, TURN_SECONDS)
    else:
        assert task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert (ended, task.cancelled(), task.cancel()) == (["cancelled"], True, False)


async def test_a_task_may_refuse_a_cancellation(time: ProcessorTime) -> None:
    async def refuses() -> str:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            return "went on"
        return ""

    async def cancels_itself() -> None:
        asyncio.get_running_loop().call_soon(ended.append, "loop ran")
        current = asyncio.current_task()
        assert current is not None
        current.cancel()
        await asyncio.Event().wait()

    ended: list[str] = []
    task = HostTask(time, ROBOT, refuses())
    task.cancel()
    assert await task == "went on"
    with pytest.raises(asyncio.CancelledError):
        await HostTask(time, ROBOT, cancels_itself())
    assert ended == ["loop ran"]


async def test_an_error_reaches_the_owner(time: ProcessorTime) -> None:
    async def work(steps: int) -> None:
        for _ in range(steps):
            await asyncio.sleep(0)
        raise ValueError(steps)

    for steps in (0, 2):
        with pytest.raises(ValueError, match=str(steps)):
            await HostTask(time, ROBOT, work(steps))
    order: list[int] = []
    assert time.run(ROBOT, partial(order.append, 1)) or time.waiting
