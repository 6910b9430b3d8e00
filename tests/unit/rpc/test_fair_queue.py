import asyncio
import ipaddress
from typing import Any

import pytest

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, QuotaClass
from appliance.rpc.fair_queue import Turns

pytestmark = pytest.mark.anyio

HOST = ipaddress.ip_address("10.0.0.1")
OTHER = ipaddress.ip_address("10.0.0.2")
WAIT = 20.0


def slots(whole: int, host: int) -> Turns[Address]:
    return Turns(Bounds(whole, host, 0, 0), lambda _host: QuotaClass.REGISTERED)


async def test_turns_go_round() -> None:
    turns, order = slots(1, 1), []

    async def request(host: Any) -> None:
        await turns.enter(host)
        order.append(host)
        await asyncio.sleep(0)
        turns.leave(host)

    await turns.enter(HOST)
    tasks = [asyncio.create_task(request(HOST)) for _ in range(5)]
    await asyncio.sleep(0)
    tasks += [asyncio.create_task(request(OTHER)) for _ in range(2)]
    await asyncio.sleep(0)
    turns.leave(HOST)
    await asyncio.gather(*tasks)
    assert order == [HOST, OTHER, HOST, OTHER, HOST, HOST, HOST]


async def test_one_host_never_has_all_slots() -> None:
    turns = slots(4, 2)
    stuck = [asyncio.create_task(turns.enter(HOST)) for _ in range(10)]
    await asyncio.sleep(0)
    for _ in range(100):
        async with asyncio.timeout(WAIT):
            await turns.enter(OTHER)
        turns.leave(OTHER)
    for task in stuck:
        task.cancel()
    await asyncio.gather(*stuck, return_exceptions=True)
    assert sum(not task.cancelled() for task in stuck) == 2
    assert not turns.waiting


async def test_turns_balance() -> None:
    turns = slots(3, 2)

    async def request(host: Any, number: int) -> None:
        await turns.enter(host)
        try:
            for _ in range(number % 4):
                await asyncio.sleep(0)
        finally:
            turns.leave(host)

    tasks = [asyncio.create_task(request((HOST, OTHER)[i % 3 == 0], i)) for i in range(200)]
    for i in range(0, 200, 7):
        await asyncio.sleep(0)
        tasks[i].cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert (turns.slots.total, dict(turns.waiting)) == (0, {})


async def test_a_cancelled_request_gets_no_turn() -> None:
    turns = slots(1, 1)
    await turns.enter(HOST)
    gone, following = (asyncio.create_task(turns.enter(HOST)) for _ in range(2))
    await asyncio.sleep(0)
    gone.cancel()
    turns.leave(HOST)
    async with asyncio.timeout(WAIT):
        await following
    turns.leave(HOST)
    assert gone.cancelled()
    assert (turns.slots.total, dict(turns.waiting)) == (0, {})


async def test_requests_of_many_guests_leave_slots_for_the_robot() -> None:
    quota_classes = {HOST: QuotaClass.REGISTERED}
    turns: Turns[Address] = Turns(Bounds(8, 4, 2, 4), lambda host: quota_classes.get(host, QuotaClass.NAMED))
    guests = [ipaddress.ip_address(f"10.1.0.{n}") for n in range(200)]
    stuck = [asyncio.create_task(turns.enter(guest)) for guest in guests]
    await asyncio.sleep(0)
    assert sum(task.done() for task in stuck) == 4
    async with asyncio.timeout(WAIT):
        for _ in range(4):
            await turns.enter(HOST)
    turns.leave(guests[0])
    await asyncio.sleep(0)
    assert sum(task.done() for task in stuck) == 5
    for task in stuck:
        task.cancel()
    await asyncio.gather(*stuck, return_exceptions=True)


async def test_a_host_that_begins_waits_for_no_guest() -> None:
    guests = [ipaddress.ip_address(f"10.1.0.{n}") for n in range(1, 5)]
    turns: Turns[Address] = Turns(
        Bounds(8, 4, 2, 4), lambda host: QuotaClass(host not in guests[3:]), own_slots=True
    )
    stuck = [asyncio.create_task(turns.enter(guest)) for guest in guests for _ in range(16)]
    await asyncio.sleep(0)
    assert turns.slots.total == 4, "the slots of hosts without a registration are full"
    assert sum(task.done() for task in stuck) == 4 + 3, (
        "and three guests have one of their own, the unknown one has not"
    )
    newcomers = [HOST, OTHER]
    for _ in range(3):
        async with asyncio.timeout(WAIT):
            for host in newcomers:
                await turns.enter(host)
        second = asyncio.create_task(turns.enter(HOST))
        await asyncio.sleep(0)
        assert not second.done(), "its second request waits like those of all others"
        turns.leave(HOST)
        await asyncio.sleep(0)
        assert second.done(), "until its own slot is free again"
        for host in newcomers:
            turns.leave(host)
    for task in stuck:
        task.cancel()
    await asyncio.gather(*stuck, return_exceptions=True)
    assert not turns.waiting


async def test_own_slots_balance() -> None:
    turns: Turns[Address] = Turns(
        Bounds(4, 2, 0, 0), lambda _host: QuotaClass.NAMED, lambda _host: "group", own_slots=True
    )
    for first, second in ((HOST, OTHER), (OTHER, HOST)):
        for order in ((0, 1, 2), (1, 0, 2), (2, 1, 0), (2, 0, 1)):
            inside = [first, second, first]
            for host in inside:
                await turns.enter(host)
            assert turns.slots.total == 2
            for one in order:
                turns.leave(inside[one])
            assert (turns.slots.total, dict(turns.waiting)) == (0, {})


async def test_many_addresses_of_one_network_take_turns_as_one() -> None:
    guests = [ipaddress.ip_address(f"10.1.0.{n}") for n in range(100)]
    turns: Turns[Address] = Turns(
        Bounds(8, 4, 0, 0),
        lambda _host: QuotaClass.REGISTERED,
        lambda host: "guests" if host in guests else host,
    )
    order: list[bool] = []

    async def request(host: Any) -> None:
        await turns.enter(host)
        order.append(host in guests)
        await asyncio.sleep(0)
        turns.leave(host)

    stuck = [asyncio.create_task(turns.enter(guest)) for guest in guests]
    await asyncio.sleep(0)
    assert sum(task.done() for task in stuck) == 4
    for _ in range(4):
        await turns.enter(HOST)
    tasks = [asyncio.create_task(request(host)) for host in [*guests, *[HOST] * 20]]
    await asyncio.sleep(0)
    turns.leave(HOST)
    while len(order) < 20:
        await asyncio.sleep(0)
    assert not any(order), "the guests had their half"
    for task in [*stuck, *tasks]:
        task.cancel()
    await asyncio.gather(*stuck, *tasks, return_exceptions=True)


async def test_a_host_in_debt_waits_outside_the_slots() -> None:
    debtor, payer = ipaddress.ip_address("10.0.0.66"), ipaddress.ip_address("10.0.0.1")
    debts = {str(debtor): 0.01}
    bounds = Bounds(1, 1, 0, 0)
    turns: Turns[Address] = Turns(
        bounds, lambda _host: QuotaClass.REGISTERED, pause=lambda host: debts.get(host, 0.0)
    )
    waiting = [asyncio.create_task(turns.enter(debtor)) for _ in range(50)]
    for _ in range(100):
        async with asyncio.timeout(20.0):
            await turns.enter(payer)
        turns.leave(payer)
        await asyncio.sleep(0)
    assert not any(task.done() for task in waiting)
    debts.clear()
    for _ in waiting:
        async with asyncio.timeout(20.0):
            await asyncio.wait(
                [task for task in waiting if not task.done()] or waiting, return_when="FIRST_COMPLETED"
            )
        turns.leave(debtor)
    async with asyncio.timeout(20.0):
        await asyncio.gather(*waiting)
