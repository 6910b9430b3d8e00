"""Read the small body of a request within limits of bytes and time."""

import asyncio

from fastapi import HTTPException, Request
from starlette.requests import ClientDisconnect

_SECONDS = 30.0


async def read_body(request: Request, longest: int) -> bytes:
    body = b""
    try:
        async with asyncio.timeout(_SECONDS):
            async for part in request.stream():
                body += part
                if len(body) > longest:
                    raise HTTPException(413, f"the body has more than {longest} bytes")
    except TimeoutError as error:
        raise HTTPException(408, f"the body takes more than {_SECONDS:g} s") from error
    except ClientDisconnect as error:
        raise HTTPException(400, "the client closed the connection") from error
    return body
