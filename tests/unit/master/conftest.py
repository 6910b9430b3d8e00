"""What the tests of control share."""

import pytest


@pytest.fixture
def anyio_backend() -> str:
    """The loop that control runs on."""
    return "asyncio"
