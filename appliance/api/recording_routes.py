"""`/v1/recordings`: what the flight recorder has; its messages are for investigators, and each fetch is on record.

No change here needs `If-Match`: a recording never changes, it only ends.
"""

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path as FilePath
from typing import Annotated, Literal, TypeVar

import msgspec
from fastapi import Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from starlette.convertors import StringConvertor, register_url_convertor

from appliance.api.access import Bearer
from appliance.api.control import ControlLink
from appliance.api.moments import given
from appliance.api.problems import ProblemError
from appliance.api.route_roles import Admin, Investigator, Operator, Viewer, answered, ask
from appliance.api.routing import Responses, Routes, answer, body, content, file
from appliance.api.services import Services
from appliance.api.streams import Held, in_thread, peer_of, turn
from appliance.channel import admin
from appliance.channel.answers.field_docs import told
from appliance.channel.answers.recording_answers import (
    RecordedMessages,
    Recording,
    RecordingBegun,
    Recordings,
    Timeline,
)
from appliance.recorder.bag_reader import Place
from appliance.recorder.mcap import as_mcap
from appliance.recorder.timeline import (
    COLUMNS,
    MOST_COLUMNS,
    MOST_NEIGHBOURS,
    NEIGHBOURS,
    messages_around,
    timeline,
)

_T = TypeVar("_T")
_PIECE = 1 << 20
_SLOW_SECONDS = 15.0  # longer than control waits for the recorder
_UNKNOWN: Responses = {404: {"description": "There is no such recording, or the flight recorder is off."}}
_BAG = file("application/octet-stream", "The bag (rosbag, format 2.0), or MCAP (profile ros1)", binary=True)
_BEGUN: Responses = {201: {"description": "It is being made.", "content": content(RecordingBegun)}}
OneId = Annotated[
    str, Path(pattern="^[0-9a-f]{20}$", description="of a recording", examples=["18ea0bb9b11c1024196c"])
]

_Moment = Annotated[
    str | None, Query(max_length=64, description="RFC 3339", examples=["2026-03-01T12:00:00.5Z"])
]
_Topics = Annotated[
    list[Annotated[str, Query(max_length=500)]],
    Query(max_length=20, description="of these alone; none: of all", examples=[["/scan"]]),
]
_Given = Annotated[
    Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)] | Annotated[str, msgspec.Meta(max_length=64)] | None,
    told("RFC 3339, or nanoseconds since the epoch"),
]
_Reading = Callable[[Recording, FilePath], _T]


class _RecordingId(StringConvertor):
    """In a path, so that the word `memory` is none."""

    regex = "[0-9a-f]{20}"


register_url_convertor("recording", _RecordingId())


class NewRecording(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is to be recorded: seconds before and after now (null: as configured), and why."""

    before: Annotated[Annotated[float, msgspec.Meta(ge=0)] | None, told("seconds")] = None
    after: Annotated[Annotated[float, msgspec.Meta(gt=0)] | None, told("seconds")] = None
    note: Annotated[str, msgspec.Meta(max_length=300)] = ""


class MemorySpan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of which time: from `since` (null: all that there is) to `until` (null: now)."""

    since: _Given = None
    until: _Given = None


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1/recordings", tags=["recordings"])
    _add_all(router, services.control)
    _add_one(router, services.control)
    _add_bag(router, services)
    _add_reading(router, services)
    return router


def _add_all(router: Routes, control: ControlLink) -> None:
    """What is there, and what is to be there."""

    @router.get("", responses=_UNKNOWN)
    async def recordings(bearer: Viewer) -> Recordings:
        """All recordings that are kept, the oldest first."""
        return await ask(control, admin.RecordingsWanted(), bearer)

    @router.post("", responses=_BEGUN | _UNKNOWN, response_class=Response, status_code=201)
    async def record_now(new: Annotated[NewRecording, body(NewRecording)], bearer: Operator) -> Response:
        """Record the last seconds, and the next ones, of what the robot says."""
        order = admin.RecordNow(new.before, new.after, new.note)
        return answer(answered(await control.ask(order, bearer, _SLOW_SECONDS)), 201)

    @router.post("/memory", operation_id="recording_of_memory", responses=_UNKNOWN)
    async def of_memory(span: Annotated[MemorySpan, body(MemorySpan)], bearer: Investigator) -> Recording:
        """What is in memory now, to be fetched as a recording for ten minutes, or until somebody else asks."""
        order = admin.RecordingOfMemory(_moment(span.since), _moment(span.until))
        return answered(await control.ask(order, bearer, _SLOW_SECONDS))


def _add_one(router: Routes, control: ControlLink) -> None:
    """A recording, without its messages."""

    @router.get("/{recording_id:recording}", responses=_UNKNOWN)
    async def recording(recording_id: OneId, bearer: Viewer) -> Recording:
        """Why a recording was made, and what it has."""
        return await ask(control, admin.RecordingWanted(recording_id), bearer)

    @router.delete("/{recording_id:recording}", operation_id="remove_recording", responses=_UNKNOWN)
    async def remove(recording_id: OneId, bearer: Admin) -> Recording:
        """Remove a recording; it is recorded who removed it. For admins."""
        order = admin.RecordingRemove(recording_id)
        return answered(await control.ask(order, bearer, _SLOW_SECONDS))


def _add_bag(router: Routes, services: Services) -> None:
    """All messages of a recording, as a file."""

    @router.get(
        "/{recording_id:recording}/bag",
        operation_id="recording_bag",
        responses=_BAG | _UNKNOWN,
        response_class=Response,
    )
    async def bag(
        recording_id: OneId,
        request: Request,
        bearer: Investigator,
        format: Annotated[Literal["bag", "mcap"], Query(description="mcap: made of the bag")] = "bag",  # noqa: A002  its name in the contract
    ) -> Response:
        """The messages of a recording, for investigators; it is recorded who fetched them."""
        give_back = services.exports.take(bearer, peer_of(request), "exports")
        try:
            return Held(await bag_response(services, recording_id, bearer, mcap=format == "mcap"), give_back)
        except BaseException:
            give_back()
            raise


def _add_reading(router: Routes, services: Services) -> None:
    """What is read of a recording's bag."""
    reading = asyncio.Semaphore(1)

    async def read(
        asked: admin.RecordingWanted | admin.RecordingRead, bearer: Bearer, what: _Reading[_T]
    ) -> _T:
        """What is read of a bag, one at a time; the recording is what control answers."""
        recording = answered(await services.control.ask(asked, bearer, _SLOW_SECONDS))
        async with turn(reading, "readings of recordings"):
            try:
                return await asyncio.to_thread(what, recording, _bag_of(services, recording.id))
            except FileNotFoundError:
                raise _gone(recording.id) from None
            except ValueError as error:
                raise ProblemError(422, "bad-input", str(error)) from error

    @router.get("/{recording_id:recording}/timeline", responses=_UNKNOWN)
    async def recording_timeline(
        recording_id: OneId,
        bearer: Viewer,
        since: _Moment = None,
        until: _Moment = None,
        columns: Annotated[
            int, Query(ge=1, le=MOST_COLUMNS, description="parts that the time is divided into")
        ] = COLUMNS,
    ) -> Timeline:
        """What flowed on each topic of a recording, and what happened, on one time line; no message is in it."""
        start, end = _moment(since), _moment(until)
        return await read(
            admin.RecordingWanted(recording_id),
            bearer,
            lambda row, bag: timeline(row, bag, start, end, columns),
        )

    @router.get("/{recording_id:recording}/messages", responses=_UNKNOWN)
    async def recording_messages(
        recording_id: OneId,
        bearer: Investigator,
        at: Annotated[
            str,
            Query(
                max_length=64,
                description="RFC 3339, or the place of a message",
                examples=["2026-03-01T12:00:00.5Z"],
            ),
        ],
        topic: _Topics = [],  # noqa: B006  FastAPI copies it
        neighbours: Annotated[
            int, Query(ge=1, le=MOST_NEIGHBOURS, description="messages before, and after")
        ] = NEIGHBOURS,
    ) -> RecordedMessages:
        """Messages of a recording around a moment, read as fields, for investigators; it is recorded who read."""
        moment = Place.parsed(at) or _moment(at)
        assert moment is not None  # noqa: S101  it is text
        return await read(
            admin.RecordingRead(recording_id, topic),
            bearer,
            lambda row, bag: messages_around(row, bag, moment, topic, neighbours),
        )


async def bag_response(services: Services, recording_id: str, bearer: Bearer, *, mcap: bool) -> Response:
    """The file, once it is on record who fetches it."""
    found = answered(await services.control.ask(admin.RecordingFetch(recording_id), bearer, _SLOW_SECONDS))
    try:  # open before it is answered: what is removed from now on is sent to its end
        pieces = await asyncio.to_thread(as_mcap if mcap else _pieces_of, _bag_of(services, found.id))
    except FileNotFoundError:
        raise _gone(found.id) from None
    except (OSError, ValueError) as error:
        raise ProblemError(503, "not-available", f"the bag of {found.id} cannot be read: {error}") from error
    name = f"rosrv-{found.id}.{'mcap' if mcap else 'bag'}"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    if not mcap:
        headers["Content-Length"] = str(found.size)
    return StreamingResponse(in_thread(pieces), media_type="application/octet-stream", headers=headers)


def _bag_of(services: Services, recording_id: str) -> FilePath:
    return services.settings.state / "recordings" / recording_id / "recording.bag"


def _gone(recording_id: str) -> ProblemError:
    return ProblemError(503, "not-available", f"the bag of {recording_id} is not there any more")


def _moment(moment: str | int | None) -> int | None:
    return given(moment) if isinstance(moment, str) else moment


def _pieces_of(path: FilePath) -> Iterator[bytes]:
    bag = path.open("rb")

    def pieces() -> Iterator[bytes]:
        with bag:
            yield from iter(lambda: bag.read(_PIECE), b"")

    return pieces()
