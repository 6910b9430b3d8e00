"""The gate's rule for all tests: only those marked `real` or `nightly` may depend on chance (CONTRIBUTING.md)."""

import contextlib
import logging
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
import structlog

from appliance.base import clock
from tests.support.determinism import WATCH, may_depend_on_chance
from tests.support.long_files import is_left_out, waits
from tests.support.virtual_clock import VirtualClock

_MOST_REAL = 100  # if each fails once in 100,000 runs, one gate in a thousand fails by chance
_TIME = pytest.StashKey[contextlib.ExitStack]()
_WALL = 1_893_456_000.0  # seconds since the epoch: the same date for each run, after that of the files
_NIGHTLY = ("tests/integration/", "tests/system/", "tests/package/", "tests/proofs/")  # unless marked `real`


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--quick", action="store_true", help="leave out the files of tests/long.txt, as `make check` does"
    )


def pytest_configure() -> None:
    """Watch for all that depends on chance, before a test module can import a function that is replaced."""
    WATCH.install()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return True if config.getoption("--quick", default=False) and is_left_out(collection_path) else None


@pytest.hookimpl(tryfirst=True)  # before -m selects by marker
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark tests with real nodes as nightly, and limit the number of cases marked `real`."""
    real = [item for item in items if item.get_closest_marker("real")]
    if len(real) > _MOST_REAL:
        raise pytest.UsageError(f"{len(real)} cases are marked `real`; the gate runs at most {_MOST_REAL}")
    for item in items:
        if item.nodeid.startswith(_NIGHTLY) and not item.get_closest_marker("real"):
            item.add_marker(pytest.mark.nightly)
    if config.getoption("--quick", default=False):
        quick = [one for one in items if one.get_closest_marker("complete") or not waits(_file(one))]
        config.hook.pytest_deselected(items=[one for one in items if one not in set(quick)])
        items[:] = quick


def _file(item: pytest.Item) -> str:
    return item.nodeid.partition("::")[0]


def _watched(item: pytest.Item) -> Generator[None, Any, Any]:
    if may_depend_on_chance(item):
        return (yield)
    with WATCH.watching() as found:
        result = yield
    if found:  # the product may have caught the error
        pytest.fail(f"this test {'; '.join(dict.fromkeys(found))}: mark it `nightly`", pytrace=False)
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Generator[None, Any, Any]:
    """Restore logging after each test: a command that it ran logs to its captured output, which is closed."""
    before, handlers = structlog.get_config(), logging.root.handlers.copy()
    result = yield
    structlog.configure(**before)
    logging.root.handlers[:] = handlers
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, Any, Any]:
    """Give the test its own virtual time, and forbid its fixtures to depend on chance."""
    if not may_depend_on_chance(item):
        item.stash[_TIME] = contextlib.ExitStack()
        item.stash[_TIME].enter_context(clock.using(VirtualClock(wall=_WALL)))
    return (yield from _watched(item))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, Any, Any]:
    return (yield from _watched(item))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, Any, Any]:
    try:
        return (yield from _watched(item))
    finally:
        if _TIME in item.stash:
            item.stash[_TIME].close()
