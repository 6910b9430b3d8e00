"""Build the REST application: its routes, the answers to errors, and the contract (OpenAPI)."""

import asyncio

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.routing import iter_route_contexts
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

import appliance
from appliance.api.console import console
from appliance.api.front import health
from appliance.api.front.control import ControlAwayError
from appliance.api.front.problems import REASON, BadInput, ProblemError, bad_input, defect
from appliance.api.front.services import Services
from appliance.api.routes import operation_routes
from appliance.api.routes.contract import contract_of
from appliance.api.routes.contract_page import PATH, page_of
from appliance.base.validation_messages import refusal
from appliance.features.table import members

_DESCRIPTION = """\
The appliance's own interface for scripts and other programs. Every call but the health probes needs a bearer token
(`rosrv token add`). Errors are problem details (RFC 9457). A change needs `If-Match` with the ETag of what it changes.
"""


def build_app(services: Services) -> FastAPI:
    app = FastAPI(
        title="ROSRV appliance",
        version=appliance.__version__,
        description=_DESCRIPTION,
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        exception_handlers={
            RequestValidationError: _invalid,
            HTTPException: _of_http,
            ProblemError: _of_problem,
            ControlAwayError: _away,
            Exception: _defect,
        },
    )
    of_features = [routes(services) for routes in members("routes", "routes")]
    for router in (
        operation_routes.routes(services, of_features),
        health.routes(services.control, services.history),
        *of_features,
    ):
        app.include_router(router)
    app.include_router(console.routes(services.settings))
    app.openapi = lambda: contract_of(app)  # type: ignore[method-assign]  # FastAPI's own way to change the contract

    async def contract() -> JSONResponse:
        return JSONResponse(app.openapi())

    async def page() -> Response:
        text = await asyncio.to_thread(page_of, app.openapi())
        return Response(text, headers=console.HEADERS, media_type="text/html")

    app.add_api_route("/v1/openapi.json", contract, include_in_schema=False)
    app.add_api_route(PATH, page, include_in_schema=False)
    return app


def _answer(request: Request, problem: ProblemError) -> Response:
    request.scope[REASON] = problem.detail
    return problem.response()


async def _of_problem(request: Request, error: Exception) -> Response:
    assert isinstance(error, ProblemError)  # noqa: S101  registered for it
    return _answer(request, error)


async def _away(request: Request, error: Exception) -> Response:
    return _answer(request, ProblemError(503, "not-available", str(error), retry_after=1))


async def _defect(request: Request, error: Exception) -> Response:
    return _answer(request, defect(error))


async def _of_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101  registered for it
    match error.status_code:
        case 404:
            problem = ProblemError(
                404,
                "unknown-path",
                f"there is no such path; {PATH} lists the paths",
                headers={"Link": f'<{PATH}>; rel="service-doc"'},
            )
        case 405:
            allowed = ", ".join(sorted(_methods(request)))
            problem = ProblemError(
                405, "wrong-method", f"this path does not have that method; it has: {allowed}",
                headers={"Allow": allowed},
            )  # fmt: skip
        case status:
            problem = ProblemError(status, "bad-request", str(error.detail), headers=error.headers)
    return _answer(request, problem)


def _methods(request: Request) -> set[str]:
    matching = [
        route
        for route in iter_route_contexts(request.app.routes)
        if route.path_regex is not None
        and route.path is not None
        and route.path_regex.match(request.url.path)
    ]
    # A literal path takes precedence over a path with a parameter.
    here = min((str(route.path) for route in matching), key=lambda path: path.count("{"), default="")
    methods = {method for route in matching if route.path == here for method in route.methods or ()}
    if not methods or "GET" in methods:
        methods |= {"GET", "HEAD"}  # `AnswersHead` serves HEAD
    return methods


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)  # noqa: S101  registered for it
    bad = [BadInput(where=".".join(map(str, found["loc"])), text=refusal(found)) for found in error.errors()]
    return _answer(request, bad_input([*dict.fromkeys(bad)]))
