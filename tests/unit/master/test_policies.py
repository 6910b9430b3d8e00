"""The policy in force over reloads, restarts, and the time limit of an unconfirmed change."""

import asyncio
import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from appliance.master.policies import Policies
from appliance.store.state import StateStore
from tests.support.control_parts import OPEN, Records

pytestmark = pytest.mark.anyio
OTHER = OPEN.replace("default=*", "default=10.0.0.5", 1)


@pytest.fixture
def anyio_backend() -> str:
    """The loop that control runs on."""
    return "asyncio"


def fail(reason: str) -> None:
    """The store could not write."""
    raise AssertionError(reason)


class Appliance:
    """The policy file and what is kept in the store; `started()` is one life of control."""

    def __init__(self, directory: Path) -> None:
        self.state = directory / "state"
        self.state.mkdir()
        self.file = directory / "policy.ini"
        self.file.write_text(OPEN)

    @contextlib.contextmanager
    def started(self, *, restarted: bool = False) -> Iterator[Policies]:
        """The policies of a control that has started; it dies at the end."""
        store = StateStore(self.state, failed=fail)
        records = cast(Any, Records())
        policies = Policies(self.file, store, records, robot=())
        policies.start(restarted=restarted)
        try:
            yield policies
        finally:
            if policies._revert is not None:
                policies._revert.cancel()
            store.close()


async def until(policies: Policies, revision: int) -> None:
    """Wait until this revision is in force."""
    async with asyncio.timeout(10):
        while policies.revision != revision:
            await asyncio.sleep(0.01)


async def test_an_unconfirmed_change_goes_back_after_a_start_of_the_appliance(tmp_path: Path) -> None:
    """The engineer who locked himself out may restart the appliance: the time limit still holds."""
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        appliance.file.write_text(OTHER)
        policies.reload(confirm_within=1.5)
        deadline = policies.confirm_by
    with appliance.started() as policies:
        assert (policies.revision, policies.current.text) == (2, OTHER)
        assert policies.confirm_by == deadline
        await until(policies, 3)
        assert policies.current.text == OPEN
        assert policies.confirm_by is None
    with appliance.started(restarted=True) as policies:
        await asyncio.sleep(0)
        assert (policies.revision, policies.confirm_by) == (3, None)


async def test_a_file_that_was_edited_ends_the_time_limit(tmp_path: Path) -> None:
    """Another file at the start is another policy: no old time limit goes off, at that start or after a crash."""
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        appliance.file.write_text(OTHER)
        policies.reload(confirm_within=0.0)
    appliance.file.write_text(OTHER + "# edited\n")
    with appliance.started() as policies:
        assert (policies.revision, policies.confirm_by) == (3, None)
    with appliance.started(restarted=True) as policies:
        assert (policies.revision, policies.confirm_by) == (3, None)


async def test_a_change_stays_confirmed_over_a_crash(tmp_path: Path) -> None:
    """Confirmed is confirmed; a change that waits for it is still waiting after a crash of control."""
    appliance = Appliance(tmp_path)
    with appliance.started() as policies:
        appliance.file.write_text(OTHER)
        policies.reload(confirm_within=300.0)
    with appliance.started(restarted=True) as policies:
        assert policies.confirm_by is not None
        assert policies.confirm_by > time.time()
        assert policies.confirm(who="operator")
    with appliance.started(restarted=True) as policies:
        assert (policies.revision, policies.confirm_by) == (2, None)
