"""Send requests to an ASGI application that runs in the test's own process."""

import asyncio
from typing import Any

import httpx


def requested(app: Any, method: str, path: str, host: str = "10.0.0.1", **given: Any) -> httpx.Response:
    """Return the answer to one request from a host."""

    async def play() -> httpx.Response:
        transport = httpx.ASGITransport(app, client=(host, 4))
        async with httpx.AsyncClient(transport=transport, base_url="http://api") as client:
            return await client.request(method, path, **given)

    return asyncio.run(play())
