import asyncio

import pytest

from appliance.supervisor import isolation_watchdog


@pytest.fixture
def guard_in_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the watchdog's calls run in the test's loop, instead of a thread for each."""
    monkeypatch.setattr(isolation_watchdog, "in_thread", asyncio.to_thread)
