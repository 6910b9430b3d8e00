import json
from typing import Annotated, Any

import httpx
import msgspec
import pytest
from fastapi import FastAPI, Request
from fastapi.responses import Response

from appliance.api.front import routing
from appliance.api.front.problems import ProblemError
from appliance.api.front.routing import Routes, body
from tests.support.asgi import requested


class Part(msgspec.Struct, forbid_unknown_fields=True):
    port: Annotated[int, msgspec.Meta(ge=1, le=65535)]


class Wanted(msgspec.Struct, forbid_unknown_fields=True):
    name: Annotated[str, msgspec.Meta(min_length=2)]
    count: int
    parts: list[Part] = []


@pytest.fixture
def app(monkeypatch: pytest.MonkeyPatch) -> FastAPI:
    monkeypatch.setattr(routing, "CONTRACT", routing.Contract())
    app, routes = FastAPI(), Routes()

    @routes.post("/")
    async def take(wanted: Annotated[Wanted, body(Wanted)]) -> Response:
        return Response(wanted.name)

    async def problem(_request: Request, error: Exception) -> Response:
        assert isinstance(error, ProblemError)
        return error.response()

    app.include_router(routes)
    app.add_exception_handler(ProblemError, problem)
    return app


def posted(app: FastAPI, sent: Any) -> httpx.Response:
    content = sent if isinstance(sent, str) else json.dumps(sent)
    return requested(app, "POST", "/", content=content, headers={"content-type": "application/json"})


@pytest.mark.parametrize(
    ("sent", "places"),
    [
        ({"name": "x", "count": "one"}, ["body.name", "body.count"]),
        ({"nmae": "xy"}, ["body", "body", "body"]),
        ({"name": "xy", "count": 1, "parts": [{"port": 1}, {"port": 0}]}, ["body.parts[1].port"]),
        ({"name": 1, "count": 1, "parts": [{"prot": 1}]}, ["body.name", "body.parts[0]"]),
        ([], ["body"]),
    ],
)
def test_every_wrong_field_is_named(app: FastAPI, sent: Any, places: list[str]) -> None:
    answer = posted(app, sent)
    assert answer.status_code == 422
    assert [error["where"] for error in answer.json()["errors"]] == places
    assert posted(app, {"name": "xy", "count": 1}).text == "xy"


@pytest.mark.parametrize(
    "rest", ["", "[" * 100_000, "1e" + "9" * 1000, '"\\ud800"', '{"a":' * 50_000, "9" * 300_000]
)
def test_invalid_json_after_a_wrong_field_is_reported(app: FastAPI, rest: str) -> None:
    answer = posted(app, f'{{"name": 1, "count": {rest}')
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:rosrv:problem:not-json")
