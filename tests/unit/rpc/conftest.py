from collections.abc import AsyncIterator
from typing import Any

import pytest

from tests.support.determinism import may_depend_on_chance
from tests.support.http_server import Client, Server, serving


@pytest.fixture
def anyio_backend(
    request: pytest.FixtureRequest, anyio_backend: tuple[str, dict[str, Any]]
) -> tuple[str, dict[str, Any]]:
    return ("asyncio", {"use_uvloop": True}) if may_depend_on_chance(request.node) else anyio_backend


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    async with serving() as server:
        yield server


@pytest.fixture
async def client(server: Server) -> Client:
    return await server.connect()
