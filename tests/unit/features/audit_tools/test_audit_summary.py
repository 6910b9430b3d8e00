import asyncio
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from fastapi.routing import APIRoute

from appliance.api.front.access import Bearer
from appliance.api.front.routing import Routes
from appliance.audit.search.denial_summary import DenialSummary
from appliance.audit.search.query import Filter
from appliance.features.audit_tools import routes
from tests.unit.audit.conftest import key, make_log, notary, path

pytestmark = pytest.mark.nightly

__all__ = ["key", "make_log", "notary", "path"]


_VIEWER = Bearer("v", "v", "viewer", 1e12, "shown")


def route(log: Path) -> Callable[..., Awaitable[DenialSummary]]:
    router = Routes()
    routes.add_summary(router, log)
    [summary] = router.routes
    assert isinstance(summary, APIRoute)
    return summary.endpoint


def test_one_summary_is_made_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    running, most, lock = 0, 0, threading.Lock()
    second = threading.Event()

    def slow(_path: Path, _wanted: Filter, _limit: int) -> DenialSummary:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        second.wait(0.05)  # long enough for the other to begin, if it could
        with lock:
            running -= 1
        return DenialSummary(0, [], 0, 0, None)

    monkeypatch.setattr(routes, "summary_of_log", slow)

    async def both() -> None:
        ask = route(tmp_path)
        await asyncio.gather(ask(_VIEWER, None, None, 20), ask(_VIEWER, None, None, 20))

    asyncio.run(both())
    assert most == 1
