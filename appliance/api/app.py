"""The REST application: routes, how their errors are answered, and the contract (OpenAPI) made from them."""

from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.routing import iter_route_contexts
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

import appliance
from appliance.api import (
    audit,
    console,
    enrol,
    evidence_routes,
    graph_routes,
    health,
    host_routes,
    live,
    metrics_route,
    monitor_changes,
    monitor_routes,
    policy_changes,
    policy_routes,
    recording_routes,
    token_routes,
    whoami,
)
from appliance.api.contract import contract_of
from appliance.api.control import ControlAwayError
from appliance.api.parameters import only_known
from appliance.api.problems import REASON, BadInput, ProblemError, bad_input, defect
from appliance.api.services import Services
from appliance.base.validation_messages import refusal

_DESCRIPTION = """\
The appliance's own interface for scripts and other programs. Every call but the health probes needs a bearer token
(`rosrv token add`). Errors are problem details (RFC 9457). A change needs `If-Match` with the ETag of what it changes.
"""


def build_app(services: Services) -> FastAPI:
    """The application; `Gate` goes around it."""
    app = FastAPI(
        title="ROSRV appliance",
        version=appliance.__version__,
        description=_DESCRIPTION,
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        dependencies=[Depends(only_known)],
        exception_handlers={
            RequestValidationError: _invalid,
            HTTPException: _of_http,
            ProblemError: _of_problem,
            ControlAwayError: _away,
            Exception: _defect,
        },
    )
    for part in (
        health,
        policy_routes,
        policy_changes,
        host_routes,
        enrol,
        monitor_routes,
        monitor_changes,
        recording_routes,
        token_routes,
        audit,
        evidence_routes,
        graph_routes,
        metrics_route,
        live,
        whoami,
    ):
        app.include_router(part.routes(services))
    app.include_router(console.routes(services.settings))
    app.openapi = lambda: contract_of(app)  # type: ignore[method-assign]  # FastAPI's own way to change the contract

    async def contract() -> JSONResponse:
        """The contract of this interface (OpenAPI 3.1)."""
        return JSONResponse(app.openapi())

    app.add_api_route("/v1/openapi.json", contract, include_in_schema=False)
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
            problem = ProblemError(404, "unknown-path", "there is nothing here")
        case 405:
            allowed = {"Allow": ", ".join(sorted(_methods(request)))}
            problem = ProblemError(405, "wrong-method", "this cannot be done here", headers=allowed)
        case status:
            problem = ProblemError(status, "bad-request", str(error.detail), headers=error.headers)
    return _answer(request, problem)


def _methods(request: Request) -> set[str]:
    """What can be done at a path; pages outside the contract are only read."""
    matching = [
        route
        for route in iter_route_contexts(request.app.routes)
        if route.path_regex is not None
        and route.path is not None
        and route.path_regex.match(request.url.path)
    ]
    if not matching:
        return {"GET"}
    # A path that is written out goes before a name.
    here = min((str(route.path) for route in matching), key=lambda path: path.count("{"))
    return {method for route in matching if route.path == here for method in route.methods or ()}


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)  # noqa: S101  registered for it
    bad = [BadInput(where=".".join(map(str, found["loc"])), text=refusal(found)) for found in error.errors()]
    return _answer(request, bad_input(bad))
