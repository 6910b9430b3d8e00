import itertools
import time
from collections.abc import Iterator

import pytest

from tests.support.autojump import anyio_backend
from tests.support.determinism import may_depend_on_chance
from tests.support.local_sockets import local_sockets as in_one_thread

__all__ = ["anyio_backend"]  # a fixture


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Repeat each test with the fixture `sockets` with real sockets and clocks, at night."""
    if "sockets" in metafunc.fixturenames and not metafunc.definition.get_closest_marker("nightly"):
        kinds = ["local", pytest.param("real", marks=pytest.mark.nightly)]
        metafunc.parametrize("sockets", kinds, indirect=True)


@pytest.fixture
def sockets(request: pytest.FixtureRequest) -> None:
    """Give the test local sockets at the gate, and real ones at night."""
    if not may_depend_on_chance(request.node):
        request.getfixturevalue("local_sockets")


@pytest.fixture
def local_sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Replace `socket.socket`, see `tests/support/local_sockets.py`. A reading of the processor time takes 1 µs."""
    monkeypatch.setattr(time, "thread_time", itertools.count(0.0, 1e-6).__next__)
    monkeypatch.setattr(time, "thread_time_ns", itertools.count(step=1000).__next__)
    with in_one_thread():
        yield
