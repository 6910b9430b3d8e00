"""Routes of `/v1/recordings`. The audit log records each fetch.

Removal needs no `If-Match`, because a recording never changes.
"""

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from fastapi import Query, Response
from fastapi.responses import StreamingResponse

from appliance.api.front.access import Bearer
from appliance.api.front.moments import parse_moment
from appliance.api.front.problems import ProblemError
from appliance.api.front.recording_id import OneId
from appliance.api.front.route_roles import Investigator, Viewer, unwrap
from appliance.api.front.routing import Responses, Routes, file
from appliance.api.front.services import Services
from appliance.api.front.streams import StreamResponse, Work, in_thread
from appliance.audit.log.log_database import LogUnreadableError
from appliance.features.recorder import requests as recording_requests
from appliance.features.recorder.bag_reader import MessagePosition
from appliance.features.recorder.mcap import as_mcap
from appliance.features.recorder.recording_answers import (
    RecordedMessages,
    Recording,
    Timeline,
)
from appliance.features.recorder.timeline import (
    COLUMNS,
    MAX_COLUMNS,
    MAX_NEIGHBOURS,
    NEIGHBOURS,
    is_record,
    messages_around,
    timeline,
)

_T = TypeVar("_T")
_PIECE = 1 << 20
_UNKNOWN: Responses = {404: {"description": "There is no such recording, or the flight recorder is off."}}
_BAG = file("application/octet-stream", "The bag (rosbag, format 2.0), or MCAP (profile ros1)", binary=True)
_Moment = Annotated[
    str | None, Query(max_length=64, description="RFC 3339", examples=["2026-03-01T12:00:00.5Z"])
]
_Topics = Annotated[
    list[Annotated[str, Query(max_length=500)]],
    Query(max_length=20, description="only these topics; by default, all", examples=[["/scan"]]),
]
_Reading = Callable[[Recording, Path], _T]


def routes(services: Services) -> Routes:
    router = Routes(prefix="/v1/recordings", tags=["recordings"])
    _add_bag(router, services)
    _add_reading(router, services)
    return router


def _add_bag(router: Routes, services: Services) -> None:
    @router.get(
        "/{recording_id:recording}/bag",
        operation_id="recording_bag",
        responses=_BAG | _UNKNOWN,
        response_class=Response,
    )
    async def bag(
        recording_id: OneId,
        bearer: Investigator,
        format: Annotated[Literal["bag", "mcap"], Query(description="mcap: converted from the bag")] = "bag",  # noqa: A002  its name in the contract
    ) -> Response:
        """Return the messages of a recording. For investigators; the audit log records who fetched them."""
        give_back = services.exports.take(bearer, "exports")
        try:
            return StreamResponse(
                await bag_response(services, recording_id, bearer, mcap=format == "mcap"), give_back
            )
        except BaseException:
            give_back()
            raise


def _add_reading(router: Routes, services: Services) -> None:
    reading = Work("readings of recordings", 1)

    async def read(
        asked: recording_requests.RecordingWanted | recording_requests.RecordingRead,
        bearer: Bearer,
        what: _Reading[_T],
    ) -> _T:
        recording = unwrap(await services.control.ask(asked, bearer))
        async with reading.turn(bearer):
            try:
                return await asyncio.to_thread(what, recording, _bag_of(services, recording.id))
            except FileNotFoundError:
                raise _gone_error(recording.id) from None
            except LogUnreadableError as error:
                raise ProblemError(503, "log-unreadable", str(error)) from error
            except ValueError as error:
                raise ProblemError(422, "bad-input", str(error)) from error

    @router.get("/{recording_id:recording}/timeline", responses=_UNKNOWN)
    async def recording_timeline(  # noqa: PLR0917  the parameters of a request
        recording_id: OneId,
        bearer: Viewer,
        since: _Moment = None,
        until: _Moment = None,
        columns: Annotated[
            int, Query(ge=1, le=MAX_COLUMNS, description="number of columns that the time is divided into")
        ] = COLUMNS,
        record: Annotated[
            str | None,
            Query(pattern="^[0-9a-f]{20}$", description="list the events around that of this audit record"),
        ] = None,
    ) -> Timeline:
        """Return the traffic of each topic of a recording, and the events, on one time line; without messages."""
        start, end = _moment(since), _moment(until)
        return await read(
            recording_requests.RecordingWanted(recording_id),
            bearer,
            lambda row, bag: timeline(
                row, bag, start, end, columns, record=record or "", log=services.audit_log
            ),
        )

    @router.get("/{recording_id:recording}/messages", responses=_UNKNOWN)
    async def recording_messages(
        recording_id: OneId,
        bearer: Investigator,
        at: Annotated[
            str,
            Query(
                max_length=64,
                description="RFC 3339, the `place` of a message, or the id of an audit record",
                examples=["2026-03-01T12:00:00.5Z"],
            ),
        ],
        topic: _Topics = [],  # noqa: B006  FastAPI copies it
        neighbours: Annotated[
            int, Query(ge=1, le=MAX_NEIGHBOURS, description="number of messages before, and after")
        ] = NEIGHBOURS,
    ) -> RecordedMessages:
        """Messages of a recording around a time, as fields. For investigators; the audit log records who read them."""
        moment = at if is_record(at) else MessagePosition.parse(at) or _moment(at)
        assert moment is not None  # noqa: S101  `_moment` returns None only for None
        return await read(
            recording_requests.RecordingRead(recording_id, topic),
            bearer,
            lambda row, bag: messages_around(row, bag, moment, topic, neighbours),
        )


async def bag_response(services: Services, recording_id: str, bearer: Bearer, *, mcap: bool) -> Response:
    found = unwrap(await services.control.ask(recording_requests.RecordingFetch(recording_id), bearer))
    try:  # open it before the answer begins: a recording that is then removed is still sent completely
        pieces = await asyncio.to_thread(as_mcap if mcap else _pieces_of, _bag_of(services, found.id))
    except FileNotFoundError:
        raise _gone_error(found.id) from None
    except (OSError, ValueError) as error:
        raise ProblemError(503, "not-available", f"the bag of {found.id} cannot be read: {error}") from error
    name = f"rosrv-{found.id}.{'mcap' if mcap else 'bag'}"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    if not mcap:
        headers["Content-Length"] = str(found.size)
    return StreamingResponse(in_thread(pieces), media_type="application/octet-stream", headers=headers)


def _bag_of(services: Services, recording_id: str) -> Path:
    return services.settings.state / "recordings" / recording_id / "recording.bag"


def _gone_error(recording_id: str) -> ProblemError:
    return ProblemError(503, "not-available", f"the bag of {recording_id} no longer exists")


def _moment(moment: str | int | None) -> int | None:
    return parse_moment(moment) if isinstance(moment, str) else moment


def _pieces_of(path: Path) -> Iterator[bytes]:
    bag = path.open("rb")

    def pieces() -> Iterator[bytes]:
        with bag:
            yield from iter(lambda: bag.read(_PIECE), b"")

    return pieces()
