"""`/v1/evidence` and `/v1/recordings/{id}/evidence`: one file of evidence that any machine can verify."""

import asyncio
from typing import Annotated

from fastapi import Query, Response
from starlette.responses import StreamingResponse

from appliance.api.front.access import Bearer
from appliance.api.front.moments import parse_moment
from appliance.api.front.problems import ProblemError
from appliance.api.front.recording_id import OneId
from appliance.api.front.route_roles import Investigator, Reader, problem_of
from appliance.api.front.routing import Responses, Routes, file
from appliance.api.front.services import Services
from appliance.api.front.streams import StreamResponse, in_thread
from appliance.api.routes.named_hosts import host_in_words
from appliance.audit.log.log_database import LogUnreadableError
from appliance.channel.admin import A, AdminAnswer, AdminRequest, PolicyWanted
from appliance.features.evidence.bundle import BundleError, RecordingSelection, TimeSpan, export
from appliance.features.evidence.page import Names

_ZIP: Responses = file("application/zip", "A ZIP file.", binary=True) | {
    404: {"description": "There is no such recording, or the log has no record of that time."}
}
_Moment = Annotated[str, Query(max_length=64, description="1h (ago), a date, or RFC 3339", examples=["1h"])]


def routes(services: Services) -> Routes:
    router = Routes(prefix="/v1", tags=["evidence"])

    @router.get("/evidence", responses=_ZIP, response_class=Response)
    async def export_evidence(bearer: Reader, since: _Moment, until: _Moment = "0s") -> Response:
        """The audit records of a period, and the policies and specifications in force, as a bundle that
        proves itself.

        For investigators, operators and admins. The audit log records each export.
        """
        return await _bundle(services, bearer, TimeSpan(parse_moment(since), parse_moment(until)))

    @router.get("/recordings/{recording_id:recording}/evidence", responses=_ZIP, response_class=Response)
    async def recording_evidence(recording_id: OneId, bearer: Investigator) -> Response:
        """Return a bundle of the time of a recording, with its messages. For investigators."""
        kept = RecordingSelection(recording_id, services.settings.state / "recordings")
        return await _bundle(services, bearer, kept)

    return router


async def _bundle(services: Services, bearer: Bearer, wanted: TimeSpan | RecordingSelection) -> Response:
    loop = asyncio.get_running_loop()

    def ask(asked: AdminRequest[A]) -> AdminAnswer[A]:
        return asyncio.run_coroutine_threadsafe(services.control.ask(asked, bearer), loop).result()

    give_back = services.exports.take(bearer, "exports")
    try:
        policy = await services.control.ask(PolicyWanted(), bearer)
        named = await asyncio.to_thread(host_in_words, policy.unwrap() if policy.ok else None)
        names = Names(services.settings.name, named)
        pieces = await asyncio.to_thread(export, services.audit_log, wanted, ask, names)
    except BaseException as error:
        give_back()
        if isinstance(error, BundleError):
            raise problem_of(error.trouble, str(error)) from error
        if isinstance(error, LogUnreadableError):
            raise ProblemError(503, "log-unreadable", str(error)) from error
        raise
    name = {"Content-Disposition": 'attachment; filename="rosrv-evidence.zip"'}
    return StreamResponse(
        StreamingResponse(in_thread(pieces), headers=name, media_type="application/zip"), give_back
    )
