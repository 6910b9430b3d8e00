import asyncio
from collections.abc import Callable

import pytest
from fastapi import HTTPException, Request
from rosrv_fleet import request_body

Message = dict[str, object]


async def _endless() -> Message:
    return {"type": "http.request", "body": b"x" * 100, "more_body": True}


async def _silent() -> Message:
    await asyncio.Event().wait()
    return {}


async def _gone() -> Message:
    return {"type": "http.disconnect"}


@pytest.mark.anyio
@pytest.mark.parametrize(("receive", "status"), [(_endless, 413), (_silent, 408), (_gone, 400)])
async def test_a_body_has_limits(
    receive: Callable[[], object], status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(request_body, "_SECONDS", 0.01)
    request = Request({"type": "http", "method": "POST", "headers": []}, receive)  # type: ignore[arg-type]  # of ASGI
    with pytest.raises(HTTPException) as refused:
        await request_body.read_body(request, 1000)
    assert refused.value.status_code == status
