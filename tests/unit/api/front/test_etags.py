from collections.abc import AsyncIterator

import httpx
import pytest
from starlette.applications import Starlette
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from appliance.api.front.etags import ConditionalGet
from tests.support.asgi import requested


def _app() -> ConditionalGet:
    count = 0

    async def counted(request: object) -> Response:
        return JSONResponse({"count": count})

    async def raised(_request: object) -> Response:
        nonlocal count
        count += 1
        return JSONResponse({"count": count})

    async def tagged(_request: object) -> Response:
        return JSONResponse({}, headers={"ETag": '"7"'})

    async def refused(_request: object) -> Response:
        return JSONResponse({}, 404)

    async def text(_request: object) -> Response:
        return Response("text", media_type="text/plain")

    async def pieces() -> AsyncIterator[bytes]:
        yield b"["
        yield b"]"

    async def streamed(_request: object) -> Response:
        return StreamingResponse(pieces(), media_type="application/json")

    handlers = {"counted": counted, "tagged": tagged, "refused": refused, "text": text, "streamed": streamed}
    routes = [Route(f"/{name}", handler) for name, handler in handlers.items()]
    return ConditionalGet(Starlette(routes=[*routes, Route("/counted", raised, methods=["POST"])]))


def asked(app: ConditionalGet, path: str, method: str = "GET", **headers: str) -> httpx.Response:
    given = {name.replace("_", "-"): value for name, value in headers.items()}
    return requested(app, method, path, headers=given)


@pytest.fixture
def app() -> ConditionalGet:
    return _app()


def test_an_unchanged_body_is_not_sent_again(app: ConditionalGet) -> None:
    first = asked(app, "/counted")
    tag = first.headers["etag"]
    assert (first.status_code, first.json()) == (200, {"count": 0})
    assert asked(app, "/counted").headers["etag"] == tag
    for known in (tag, f'"x", {tag}', f"W/{tag}", "*"):
        again = asked(app, "/counted", if_none_match=known)
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
        assert "content-length" not in again.headers
    for other in ("", '"x"', tag.strip('"')):
        assert asked(app, "/counted", if_none_match=other).json() == {"count": 0}


def test_a_changed_body_is_sent(app: ConditionalGet) -> None:
    tag = asked(app, "/counted").headers["etag"]
    assert "etag" not in asked(app, "/counted", "POST").headers
    again = asked(app, "/counted", if_none_match=tag)
    assert (again.status_code, again.json()) == (200, {"count": 1})
    assert again.headers["etag"] != tag


@pytest.mark.parametrize(
    ("path", "status", "tag"),
    [("/tagged", 200, '"7"'), ("/refused", 404, None), ("/text", 200, None), ("/streamed", 200, None)],
)
def test_these_answers_get_no_etag_of_the_body(
    app: ConditionalGet, path: str, status: int, tag: str | None
) -> None:
    answer = asked(app, path, if_none_match=f"{tag or '*'}")
    assert (answer.status_code, answer.headers.get("etag")) == (status, tag)
    assert answer.content
