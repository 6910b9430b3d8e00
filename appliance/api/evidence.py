"""`/v1/evidence`: what happened in a span of time, in one file that proves itself elsewhere."""

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from typing import Annotated, Any

from fastapi import Query, Request, Response
from starlette.responses import StreamingResponse

from appliance.api.problems import ProblemError
from appliance.api.roles import Operator, problem_of
from appliance.api.routing import Responses, Routes
from appliance.api.services import Services
from appliance.api.streams import Held, peer_of
from appliance.audit.database import LogUnreadableError
from appliance.audit.moment import MomentError, parse_moment
from appliance.channel.admin import AdminAnswer, AdminRequest
from appliance.evidence.bundle import BundleError, Span, export

_ZIP: Responses = {
    200: {
        "description": "A ZIP file.",
        "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
    },
    404: {"description": "The log has no record of that time."},
}
_Moment = Annotated[str, Query(max_length=64, description="1h (ago), a date, or RFC 3339")]


def routes(services: Services) -> Routes:
    """The route."""
    router = Routes(prefix="/v1", tags=["audit"])

    @router.get("/evidence", operation_id="export_evidence", responses=_ZIP)
    async def export_evidence(
        request: Request, bearer: Operator, since: _Moment, until: _Moment = "0s"
    ) -> Response:
        """The audit records of a time, and the policies and specifications in force, as a bundle that proves itself.

        For operators. It is on record who exported what.
        """
        now, loop = time.time_ns(), asyncio.get_running_loop()
        try:
            span = Span(parse_moment(since, now), parse_moment(until, now))
        except (MomentError, OverflowError, ValueError) as error:
            raise ProblemError(422, "bad-input", str(error)) from error

        def ask(asked: AdminRequest[Any]) -> AdminAnswer[Any]:
            return asyncio.run_coroutine_threadsafe(services.control.ask(asked, bearer), loop).result()

        give_back = services.exports.take(bearer, peer_of(request), "exports")
        try:
            pieces = await asyncio.to_thread(export, services.audit_log, span, ask)
        except BaseException as error:
            give_back()
            if isinstance(error, BundleError):
                raise problem_of(error.trouble, str(error)) from error
            if isinstance(error, LogUnreadableError):
                raise ProblemError(503, "log-unreadable", str(error)) from error
            raise
        name = {"Content-Disposition": 'attachment; filename="rosrv-evidence.zip"'}
        return Held(StreamingResponse(_given(pieces), headers=name, media_type="application/zip"), give_back)

    return router


async def _given(pieces: Iterator[bytes]) -> AsyncIterator[bytes]:
    while (piece := await asyncio.to_thread(next, pieces, None)) is not None:
        yield piece
