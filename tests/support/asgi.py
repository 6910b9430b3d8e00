from typing import Any

import httpx

from tests.support.inline_loop import run


async def sent(app: Any, method: str, path: str, host: str = "10.0.0.1", **given: Any) -> httpx.Response:
    transport = httpx.ASGITransport(app, client=(host, 4))
    async with httpx.AsyncClient(transport=transport, base_url="http://api") as client:
        return await client.request(method, path, **given)


def requested(app: Any, method: str, path: str, host: str = "10.0.0.1", **given: Any) -> httpx.Response:
    return run(sent(app, method, path, host, **given))
