import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import msgspec
import pytest

from appliance.api.front.control import ControlAwayError, ControlLink
from appliance.api.front.health import Health, routes
from appliance.api.front.history import SampleHistory
from appliance.api.front.problems import ProblemError
from appliance.channel.answers.measures import Measures
from tests.support.answers import example
from tests.support.memory_channel import HeldChannel

pytestmark = pytest.mark.anyio
SERVING: dict[str, Any] = {"probe": "passed", "relay": "connected", "rosmaster": "reachable"}


class Probed:
    """REST before a control in a given state. `looks` counts the queries to control."""

    def __init__(self, *statuses: dict[str, Any] | None) -> None:
        self._statuses = list(statuses)
        self.looks = 0
        self.history = SampleHistory(self._measures)
        self.control = ControlLink(lambda _tokens: None, lambda: None)
        self.control.attach(HeldChannel())
        self.control.known = True
        (self._ready,) = [
            route.endpoint  # type: ignore[attr-defined]  # it is a route with one
            for route in routes(self.control, self.history).routes
            if route.path == "/readyz"  # type: ignore[attr-defined]  # and a path
        ]

    async def _measures(self) -> Measures:
        self.looks += 1
        status = self._statuses.pop(0) if len(self._statuses) > 1 else self._statuses[0]
        if status is None:
            raise ControlAwayError("being restarted")
        return example(Measures, status=status, nodes={"live": 0})

    async def ready(self) -> str:
        try:
            answer = await self._ready()
        except ProblemError as problem:
            assert problem.status == 503
            return problem.kind
        return str(msgspec.json.decode(answer.body, type=Health).status)


@contextlib.asynccontextmanager
async def sampled(probed: Probed) -> AsyncIterator[None]:
    async with asyncio.timeout(30):
        task = asyncio.create_task(probed.history.run())
        await probed.history.after(0)
        yield
        task.cancel()


@pytest.mark.parametrize(
    "wrong",
    [
        {"probe": "the ROS Master answers"}, {"relay": "1 of 2 are away"}, {"relay": "away"},
        {"rosmaster": "being rebuilt"}, {"audit": {"failed": "disk full", "on_failure": "deny"}}, None,
    ],
)  # fmt: skip
async def test_it_is_not_ready_while_nodes_are_not_served(wrong: dict[str, Any] | None) -> None:
    unready = None if wrong is None else SERVING | wrong
    probed = Probed(unready, unready, SERVING)
    async with sampled(probed):
        assert await probed.ready() == "not-served"
        assert await probed.ready() == "ready"


async def test_it_is_not_ready_during_a_lapse_of_the_lease() -> None:
    probed = Probed(SERVING)
    async with sampled(probed):
        probed.control.paused = "the lease has lapsed"
        assert await probed.ready() == "not-served"


async def test_a_log_that_may_fail_does_not_make_it_unready() -> None:
    probed = Probed(SERVING | {"audit": {"failed": "disk full", "on_failure": "allow"}})
    async with sampled(probed):
        assert await probed.ready() == "ready"
        assert probed.looks == 1


async def test_many_probes_ask_control_once() -> None:
    probed = Probed(SERVING | {"relay": "away"})
    async with sampled(probed):
        assert set(await asyncio.gather(*(probed.ready() for _ in range(200)))) == {"not-served"}
        assert probed.looks <= 3
