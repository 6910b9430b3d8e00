"""Tests of `appliance.api.health`."""

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.api.control import ControlAwayError
from appliance.api.health import Health, Status, routes
from appliance.api.history import History
from appliance.api.problems import ProblemError
from appliance.api.services import Services

SERVING: dict[str, Any] = {
    "probe": "passed",
    "audit": {"failed": None, "on_failure": "deny"},
    "relay": "connected",
    "rosmaster": "reachable",
}


def test_what_control_adds_is_passed_on() -> None:
    """A section of the status that a newer part of the appliance adds is shown, not a failure."""
    fields = {
        "version": "1", "master": "http://10.0.0.1:11311", "since": 1.0,
        "processes": [{"role": "control", "pid": 1, "since": "-", "restarts": 0, "walls": "", "lacks": []}],
        "isolation": "none", "relaying": "all", "mediation": "full", "firewall": {}, "probe": "",
        "policy": {
            "revision": 1, "file": "f", "source": "f", "who": "disk", "differs_from_file": False, "warnings": 0,
            "confirm_by": None,
        },
        "rosmaster": "reachable", "relay": "connected", "nodes": 0, "shadows": 0, "topics": 0, "services": 0,
        "connections": 0, "messages": 0, "dropped": 0,
        "audit": {"lag_records": 0, "lag_seconds": 0.0, "failed": None, "on_failure": "deny", "degraded": None},
    }  # fmt: skip
    assert Status.model_validate(fields | {"tunnels": [1]}).model_dump() == fields | {"tunnels": [1]}


class Probed:
    """REST in front of a control that says how it stands; `looks` counts how often it was asked."""

    def __init__(self, *statuses: dict[str, Any] | None) -> None:
        self._statuses = list(statuses)
        self.looks = 0
        self.history = History(self._measures)
        services = SimpleNamespace(control=SimpleNamespace(connected=True), history=self.history)
        (self._ready,) = [
            one.endpoint  # type: ignore[attr-defined]  # it is a route with one
            for one in routes(cast(Services, services)).routes
            if one.path == "/readyz"  # type: ignore[attr-defined]  # and a path
        ]

    async def _measures(self) -> dict[str, Any]:
        self.looks += 1
        status = self._statuses.pop(0) if len(self._statuses) > 1 else self._statuses[0]
        if status is None:
            raise ControlAwayError("being restarted")
        return {
            "status": status, "decisions": [], "relayed": {}, "monitors": [], "nodes": {"live": 0},
        }  # fmt: skip

    async def ready(self) -> str:
        """What the probe says: `ready`, or the kind of the problem."""
        try:
            answer = await self._ready()
        except ProblemError as problem:
            assert problem.status == 503
            return problem.kind
        assert isinstance(answer, Health)
        return answer.status


def play(probed: Probed, what: Any) -> None:
    """Sample while `what()` plays."""

    async def whole() -> None:
        async with asyncio.timeout(30):
            task = asyncio.create_task(probed.history.run())
            await what()
            task.cancel()

    asyncio.run(whole())


@pytest.mark.parametrize(
    "wrong",
    [
        {"probe": "the ROS Master answers"}, {"relay": "1 of 2 are away"}, {"relay": "away"},
        {"rosmaster": "being rebuilt"}, {"audit": {"failed": "disk full", "on_failure": "deny"}}, None,
    ],
)  # fmt: skip
def test_it_is_not_ready_while_nodes_are_not_served(wrong: dict[str, Any] | None) -> None:
    """Each reason makes it 503; the moment that it goes, 200."""
    unready = None if wrong is None else SERVING | wrong
    probed = Probed(unready, unready, SERVING)

    async def what() -> None:
        await probed.history.after(0)
        assert await probed.ready() == "not-served"
        assert await probed.ready() == "ready"

    play(probed, what)


def test_a_log_that_may_fail_does_not_make_it_unready() -> None:
    """With `on_audit_failure: allow` nodes are served all the while."""
    probed = Probed(SERVING | {"audit": {"failed": "disk full", "on_failure": "allow"}})

    async def what() -> None:
        await probed.history.after(0)
        assert await probed.ready() == "ready"
        assert probed.looks == 1

    play(probed, what)


def test_however_many_ask_control_is_not_flooded() -> None:
    """Many probes of an appliance that is not ready are one look at control."""
    probed = Probed(SERVING | {"relay": "away"})

    async def what() -> None:
        await probed.history.after(0)
        assert set(await asyncio.gather(*(probed.ready() for _ in range(200)))) == {"not-served"}
        assert probed.looks <= 3

    play(probed, what)
