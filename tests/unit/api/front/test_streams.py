import asyncio
from collections.abc import Callable
from typing import Any

import pytest
from starlette.responses import Response

from appliance.api.front.access import Bearer
from appliance.api.front.problems import ProblemError
from appliance.api.front.streams import StreamResponse, Streams, Work
from appliance.channel.answers.token_answers import TokenRole
from appliance.quotas.table import REST_STREAMS


def bearer(name: str, role: TokenRole = "viewer") -> Bearer:
    return Bearer(name, name, role, 1e12, "shown")


def taken(streams: Streams, who: Bearer, most: int = 100) -> list[Callable[[], None]]:
    places: list[Callable[[], None]] = []
    try:
        while len(places) < most:
            places.append(streams.take(who, "clients follow"))
    except ProblemError as problem:
        assert (problem.status, problem.headers["Retry-After"]) == (503, "10")
    return places


def test_two_hundred_viewers_leave_slots_to_operators() -> None:
    streams = Streams(REST_STREAMS, 64)
    assert sum(len(taken(streams, bearer(f"v{one}"))) for one in range(200)) == 48
    assert len(taken(streams, bearer("op", "operator"))) == 16


def test_one_token_has_a_quota_and_one_machine_none() -> None:
    """Browsers behind one address each have a session, which counts."""
    streams = Streams(REST_STREAMS, 64)
    assert len(taken(streams, bearer("a"))) == 24
    assert all(taken(streams, bearer(f"session {one}"), 1) for one in range(24))


@pytest.mark.parametrize(("whole", "first"), [(1, 1), (2, 1), (16, 6)])
def test_quotas_scale_with_the_total(whole: int, first: int) -> None:
    streams = Streams(REST_STREAMS, whole)
    assert len(taken(streams, bearer("a"))) == first
    assert bool(taken(streams, bearer("op", "admin"), 1)) is (whole > 1)


@pytest.mark.parametrize("fails", [False, True])
def test_a_slot_is_released_when_the_response_ends(*, fails: bool) -> None:
    streams = Streams(REST_STREAMS, 1)

    async def send(_message: Any) -> None:
        if fails:
            raise ConnectionResetError

    async def receive() -> Any:
        return {"type": "http.disconnect"}

    for _ in range(3):
        held = StreamResponse(Response("x"), streams.take(bearer("a"), "clients follow"))
        try:
            asyncio.run(held({"type": "http"}, receive, send))
        except ConnectionResetError:
            assert fails
    assert not streams.roles


@pytest.mark.anyio
async def test_a_viewer_with_many_requests_leaves_turns_to_an_admin() -> None:
    work, order, ends = Work("dry runs", 2), list[str](), [asyncio.Event() for _ in range(3)]

    async def ask(who: Bearer) -> None:
        async with work.turn(who):
            order.append(who.name)
            await ends[min(len(order), 3) - 1].wait()

    asked = [asyncio.create_task(ask(bearer("flood"))) for _ in range(60)]
    await asyncio.sleep(0)
    asked += [asyncio.create_task(ask(who)) for who in (bearer("other"), bearer("root", "admin"))]
    await asyncio.sleep(0)
    assert order == ["flood", "root"]
    ends[0].set()
    ends[2].set()
    while "other" not in order:
        await asyncio.sleep(0)
    assert order.index("other") == 3, "one more request of the flood was waiting before"
    for task in asked:
        task.cancel()
    await asyncio.gather(*asked, return_exceptions=True)


@pytest.mark.anyio
@pytest.mark.parametrize("whole", [1, 2, 4])
async def test_every_token_gets_a_turn(whole: int) -> None:
    work = Work("summaries", whole)
    for who in (bearer("v"), bearer("root", "admin")):
        async with work.turn(who):
            pass
