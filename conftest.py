"""The gate's rule for all tests: only those marked `real` or `nightly` may depend on chance (CONTRIBUTING.md)."""

import contextlib
import gc
import importlib.util
import logging
import os
import signal
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
import structlog

from appliance.base import clock
from tests.support.determinism import WATCH, may_depend_on_chance
from tests.support.long_files import LONG, is_left_out, waits
from tests.support.virtual_clock import VirtualClock

_MAX_REAL = 100  # if each fails once in 100,000 runs, one gate in a thousand fails by chance
_TIME = pytest.StashKey[contextlib.ExitStack]()
_WALL = 1_893_456_000.0  # seconds since the epoch: the same date for each run, after that of the files
_REAL_CLOCK = clock.source()
_NIGHTLY = (  # unless marked `real`
    "tests/integration/", "tests/system/", "tests/package/", "lab/tests/proofs/",
    "fleet/tests/system/",
)  # fmt: skip


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--quick", action="store_true", help="leave out the files of tests/long.txt, as `make check` does"
    )
    parser.addoption("--part", default="1/1", help="2/3 runs every third test, from the second")


def pytest_configure(config: pytest.Config) -> None:
    """Watch for chance, let programs hear SIGINT, and as root give each worker of pytest-xdist its own loopback.

    A script's background process ignores SIGINT, and so does every program that it starts: a test that interrupts it
    would wait until the time limit. On a common loopback, the port of a killed node could go to the next node, which
    would answer for it.
    """
    WATCH.install()  # before a test module can import a function that is replaced
    # The collected tests stay in memory: the garbage collector would scan their millions of objects again and again.
    gc.set_threshold(700, 10, 100)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # Not imported above: an environment for the collector alone has no namespaces, and its gate opens no sockets.
    if not hasattr(config, "workerinput") or importlib.util.find_spec("pyroute2") is None:
        return
    if importlib.import_module("appliance.network.namespaces").has_privileges():
        inside = contextlib.ExitStack()
        inside.enter_context(importlib.import_module("tests.support.own_namespace").own_loopback())
        config.add_cleanup(inside.close)


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    cores = len(os.sched_getaffinity(0))
    return cores + 1 if config.option.numprocesses == "logical" else 2 * cores


def pytest_collection_finish() -> None:
    """Leave the collected tests and their modules out of the garbage collector's scans."""
    gc.freeze()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return True if config.getoption("--quick", default=False) and is_left_out(collection_path) else None


@pytest.hookimpl(tryfirst=True)  # before -m selects by marker
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark tests with real nodes as nightly, limit the cases marked `real`, and begin with those of tests/long.txt."""
    real = [item for item in items if item.get_closest_marker("real")]
    if len(real) > _MAX_REAL:
        raise pytest.UsageError(f"{len(real)} cases are marked `real`; the gate runs at most {_MAX_REAL}")
    for item in items:
        if item.nodeid.startswith(_NIGHTLY) and not item.get_closest_marker("real"):
            item.add_marker(pytest.mark.nightly)
    part, parts = map(int, config.getoption("--part", default="1/1").split("/"))
    others = [one for number, one in enumerate(items, 1) if (number - part) % parts]
    config.hook.pytest_deselected(items=others)
    items[:] = items[part - 1 :: parts]
    if config.getoption("--quick", default=False):
        quick = [one for one in items if one.get_closest_marker("complete") or not waits(_file(one))]
        config.hook.pytest_deselected(items=[one for one in items if one not in set(quick)])
        items[:] = quick
    rank = {name: number for number, name in enumerate(LONG)}
    items.sort(key=lambda item: rank.get(_file(item), len(LONG)))


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
    """End the test's virtual time. A test that leaves another clock makes the next ones wait for ever: name it."""
    try:
        return (yield from _watched(item))
    finally:
        if _TIME in item.stash:
            item.stash[_TIME].close()
        left = [f"time.{name}" for name in WATCH.restore_times()]
        if clock.source() is not _REAL_CLOCK:
            clock._source.set(_REAL_CLOCK)
            left.append("appliance.base.clock")
        if left:
            pytest.fail(f"this test left replaced: {', '.join(left)}", pytrace=False)
