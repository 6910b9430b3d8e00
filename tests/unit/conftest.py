from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.autojump import autojump
from tests.support.determinism import may_depend_on_chance


@pytest.fixture
def anyio_backend(request: pytest.FixtureRequest) -> Iterator[tuple[str, dict[str, Any]]]:
    if may_depend_on_chance(request.node):
        yield "asyncio", {}
    else:
        with autojump() as new_loop:
            yield "asyncio", {"loop_factory": new_loop}
