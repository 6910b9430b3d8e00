"""The event loop of asynchronous unit tests: in virtual time, except for the files of `real_loop.txt`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.autojump import autojump

_HERE = Path(__file__).parent
_REAL_LOOP = tuple(
    f"{_HERE.relative_to(_HERE.parents[1])}/{line}"
    for line in (_HERE / "real_loop.txt").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
)


@pytest.fixture
def anyio_backend(request: pytest.FixtureRequest) -> Iterator[tuple[str, dict[str, Any]]]:
    """Give anyio the loop for the test and its fixtures."""
    node = request.node
    marked = node.get_closest_marker("real") or node.get_closest_marker("nightly")
    if marked or node.nodeid.startswith(_REAL_LOOP):
        yield "asyncio", {}
    else:
        with autojump() as new_loop:
            yield "asyncio", {"loop_factory": new_loop}
