"""Fixtures that the tests of control share."""

import pytest


@pytest.fixture
def anyio_backend() -> str:
    """Return the loop that control runs on."""
    return "asyncio"
