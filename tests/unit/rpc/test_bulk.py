import asyncio
import datetime
import ipaddress
from functools import partial
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.master.parameter_charges import measure
from appliance.quotas.pool import QuotaClass
from appliance.rpc.fair_queue import AT_ONCE, Bulk, LargeWrites, bulk_turns, weigh
from appliance.rpc.processor_time import ProcessorTime
from roswire.xmlrpc import Value, build_response

pytestmark = pytest.mark.anyio

TIME = ProcessorTime(lambda host: host)
HOSTS = [ipaddress.ip_address(f"10.0.0.{number}") for number in range(1, 5)]
VALUES: st.SearchStrategy[Value] = st.recursive(
    st.one_of(st.booleans(), st.integers(-9, 9), st.floats(), st.text("x<&>\u00e9", max_size=30)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=5), st.dictionaries(st.text("a&", max_size=5), inner, max_size=5)
    ),
    max_leaves=30,
)


async def test_room_for_one_of_a_host_and_two_in_all() -> None:
    turns = bulk_turns(lambda _host: QuotaClass.REGISTERED)
    inside: list[Any] = []
    go = asyncio.Event()

    async def request(host: Any) -> None:
        with Bulk(turns, host, TIME) as bulk:
            await bulk.take()
            await bulk.take()  # again is nothing more
            inside.append(host)
            await go.wait()
            inside.remove(host)

    tasks = [asyncio.create_task(request(host)) for host in [HOSTS[0]] * 3 + HOSTS[1:]]
    for _ in range(10):
        await asyncio.sleep(0)
    assert inside == HOSTS[:AT_ONCE]
    go.set()
    await asyncio.gather(*tasks)
    assert not inside


async def test_room_comes_back_after_a_failure() -> None:
    turns = bulk_turns(lambda _host: QuotaClass.REGISTERED)
    for _ in range(3):
        with pytest.raises(KeyError), Bulk(turns, HOSTS[0], TIME) as bulk:
            await bulk.take()
            raise KeyError
        with Bulk(turns, HOSTS[0], TIME):
            pass
    with Bulk(turns, HOSTS[0], TIME) as bulk:
        async with asyncio.timeout(20):
            await bulk.take()
        assert bulk.taken


@given(value=VALUES)
def test_a_value_has_the_same_weight_as_in_the_mirror(value: Value) -> None:
    assert weigh(value, 1 << 30) == measure(value)[0]


def test_counting_ends_at_the_limit() -> None:
    wide: Value = [list(range(1000)) for _ in range(1000)]
    assert 5000 <= weigh(wide, 5000) < 20_000
    assert 5000 <= weigh(dict.fromkeys(map(str, range(100_000)), 1), 5000) < 6000
    assert weigh(datetime.datetime(2025, 1, 1), 10) > 0  # noqa: DTZ001 - XML-RPC has no time zones


@pytest.mark.parametrize("letter", ["x", "&", "<", ">", "\u00e9", "\U00010348"], ids=ascii)
def test_weight_is_about_what_is_written(letter: str) -> None:
    """Bounded parameters could not be sent if the weight were wrong by more than a factor of two."""
    value: Value = {"a": [1, 2.5, "text", {"b": True}] * 100, "c": letter * 5000, letter * 5000: 1}
    texts: list[Value] = [letter * 5000] * 9
    for one in (value, texts):
        assert 0.5 < weigh(one, 1 << 30) / len(build_response(one)) < 2
        assert measure(one)[0] == weigh(one, 1 << 30)


async def test_large_values_of_a_host_go_one_at_a_time() -> None:
    large = LargeWrites(1000, lambda _host: QuotaClass.REGISTERED)
    inside: list[str] = []
    go = asyncio.Event()

    async def write(name: str, host: Any, size: int) -> None:
        async with large.turn(host, ["x" * size]):
            inside.append(name)
            await go.wait()
            inside.remove(name)

    guest, robot = HOSTS[:2]
    wanted = (("first", guest, 2000), ("second", guest, 2000), ("small", guest, 10), ("robot", robot, 2000))
    tasks = [asyncio.create_task(write(*one)) for one in wanted]
    for _ in range(10):
        await asyncio.sleep(0)
    assert inside == ["first", "small", "robot"]
    go.set()
    await asyncio.gather(*tasks)
    assert not inside


async def test_a_large_value_has_its_turn_until_the_standby_has_it() -> None:
    has_it = asyncio.Event()

    async def stored() -> None:
        await has_it.wait()

    large, written = LargeWrites(1000, lambda _host: QuotaClass.REGISTERED, stored), list[str]()

    async def write(name: str, host: Any, size: int) -> None:
        async with large.turn(host, ["x" * size]):
            written.append(name)

    guest, robot = HOSTS[:2]
    wanted = (("first", guest, 2000), ("second", guest, 2000), ("small", guest, 10), ("robot", robot, 2000))
    tasks = [asyncio.create_task(write(*one)) for one in wanted]
    for _ in range(10):
        await asyncio.sleep(0)
    assert written == ["first", "small", "robot"]
    has_it.set()
    await asyncio.gather(*tasks)
    assert written[-1] == "second"


@pytest.mark.nightly
async def test_the_work_of_a_thread_is_charged_to_its_host() -> None:
    time, order = ProcessorTime(lambda host: host, lambda: 0.0), list[Any]()
    bulk = Bulk(bulk_turns(lambda _host: QuotaClass.REGISTERED), HOSTS[0], time)
    with pytest.raises(ZeroDivisionError):
        await bulk.in_thread(lambda: sum(range(200_000)) / 0)
    time.charge(HOSTS[2], 10.0)  # the turn is over
    for host in (HOSTS[0], HOSTS[1]):
        time.run(host, partial(order.append, host))
    while time.waiting:
        await asyncio.sleep(0)
    assert order == [HOSTS[1], HOSTS[0]]
