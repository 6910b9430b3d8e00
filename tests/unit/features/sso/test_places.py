import asyncio
import contextlib

import pytest

from appliance.api.front.problems import ProblemError
from appliance.features.sso.routes import MAX_AT_ONCE, MAX_WAITING, SignOnPlaces, SignOnRates
from tests.support.virtual_clock import let_time_pass

pytestmark = pytest.mark.anyio


async def occupy(places: SignOnPlaces, address: str, seconds: float) -> None:
    """Begin again and again, as often as the places allow it."""
    while True:
        with contextlib.suppress(ProblemError):
            async with places.place(address):
                await asyncio.sleep(seconds)
        await asyncio.sleep(0.01)


async def sign_in(places: SignOnPlaces, address: str, seconds: float = 0.1) -> float:
    """Return the seconds until the person had a place."""
    loop = asyncio.get_running_loop()
    began = loop.time()
    async with places.place(address):
        waited = loop.time() - began
        await asyncio.sleep(seconds)
    return waited


@pytest.mark.parametrize("strangers", [1, 5, 12, 40])
async def test_unknown_hosts_keep_no_person_from_signing_in(strangers: int) -> None:
    """Each holds its place for as long as a slow provider takes."""
    places = SignOnPlaces()
    flood = [
        asyncio.create_task(occupy(places, f"10.9.0.{number % strangers}", 4.0))
        for number in range(max(12, strangers))
    ]
    await asyncio.sleep(60)
    for people in range(1, 7):
        waited = await asyncio.gather(
            *(sign_in(places, f"10.0.{people}.{person}") for person in range(people))
        )
        assert max(waited) < 5.0
    for task in flood:
        task.cancel()
    await asyncio.gather(*flood, return_exceptions=True)


async def test_one_address_may_have_all_places_while_no_other_wants_one() -> None:
    places = SignOnPlaces()
    waited = await asyncio.gather(*(sign_in(places, "10.0.0.9", 1.0) for _ in range(MAX_AT_ONCE)))
    assert max(waited) == 0.0
    waited = await asyncio.gather(*(sign_in(places, "10.0.0.9", 1.0) for _ in range(3 * MAX_AT_ONCE)))
    assert max(waited) == pytest.approx(2.0)


async def test_a_full_queue_loses_one_of_the_address_that_has_most() -> None:
    places = SignOnPlaces()
    flood = [asyncio.create_task(sign_in(places, "10.9.0.1", 4.0)) for _ in range(MAX_AT_ONCE + MAX_WAITING)]
    await asyncio.sleep(1)
    assert await sign_in(places, "10.0.0.9") == pytest.approx(3.0)
    with pytest.raises(ProblemError, match="too many people"):
        await asyncio.gather(*(sign_in(places, "10.9.0.1") for _ in range(MAX_WAITING)))
    for task in flood:
        task.cancel()
    ended = await asyncio.gather(*flood, return_exceptions=True)
    assert sum(isinstance(one, ProblemError) for one in ended) >= 1


async def test_a_place_that_is_given_up_while_waiting_is_not_lost() -> None:
    places = SignOnPlaces()
    running = [asyncio.create_task(sign_in(places, f"10.9.0.{number}", 1.0)) for number in range(6)]
    await asyncio.sleep(0.5)
    leaving = asyncio.create_task(sign_in(places, "10.0.0.8"))
    await asyncio.sleep(0.1)
    leaving.cancel()
    await asyncio.gather(leaving, return_exceptions=True)
    with pytest.raises(ProblemError):
        async with asyncio.timeout(30):
            await asyncio.gather(*(sign_in(places, "10.0.0.7", 30.0) for _ in range(20)))
    await asyncio.gather(*running)
    await asyncio.sleep(60)
    assert await sign_in(places, "10.0.0.9") == 0.0


@pytest.mark.parametrize("people", [10, 20, 200])
async def test_people_behind_one_address_all_sign_in(people: int) -> None:
    """Twenty begin at once, and each that has succeeded makes room for the next."""
    rates = SignOnRates(20)
    for first in range(0, people, 20):
        present = range(first, min(people, first + 20))
        for _ in present:
            rates.begin("10.0.0.9")
        for _ in present:
            rates.require_no_failures("10.0.0.9")
            rates.succeeded("10.0.0.9")


def test_sign_ons_that_are_not_completed_or_fail_are_limited() -> None:
    rates = SignOnRates(20)
    for _ in range(20):
        rates.begin("10.9.0.1")
    with pytest.raises(ProblemError, match="are not completed"):
        rates.begin("10.9.0.1")
    rates.begin("10.0.0.9")
    for _ in range(20):
        rates.failed("10.9.0.2")
    with pytest.raises(ProblemError, match="failed"):
        rates.require_no_failures("10.9.0.2")
    with pytest.raises(ProblemError, match="failed"):
        rates.begin("10.9.0.2")
    let_time_pass(4.0)
    rates.begin("10.9.0.1")
    rates.begin("10.9.0.2")
