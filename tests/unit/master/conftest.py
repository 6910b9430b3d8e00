"""Fixtures shared by the tests of control."""

import pytest


@pytest.fixture
def anyio_backend() -> str:
    """Return the loop that control runs on."""
    return "asyncio"
