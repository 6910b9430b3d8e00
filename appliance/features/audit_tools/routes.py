"""`/v1/audit`: search, one record, follow live, verify, export. The api reads the log's file, but cannot write it."""

import asyncio
import contextlib
import itertools
import json
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from fastapi import Depends, Header, Query, Request, Response
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.responses import JSONResponse, StreamingResponse

from appliance.api.front.access import Bearer
from appliance.api.front.moments import parse_moment
from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import Operator, Viewer, reads_contents
from appliance.api.front.routing import Responses, Routes, file
from appliance.api.front.services import Services
from appliance.api.front.streams import StreamResponse, Streams, Work, in_thread, peer_of
from appliance.api.routes.log_reader import (
    RECORD_REFERENCE,
    UNKNOWN,
    LogReader,
    OneRecord,
    readable,
    readable_by,
)
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record import Severity
from appliance.audit.log.record_format import LogEntry, as_object
from appliance.audit.proof.chain_findings import Verification
from appliance.audit.proof.chain_proofs import evidence, evidence_line
from appliance.audit.proof.copies import SignedCheckpoint, signed_checkpoints
from appliance.audit.proof.verification import verify
from appliance.audit.search.denial_summary import LARGEST_SUMMARY, DenialSummary, summary_of_log
from appliance.audit.search.equality import equality_of
from appliance.audit.search.query import Filter
from appliance.audit.search.search import Follower, export, search
from appliance.channel.answers.field_docs import doc
from appliance.features.audit_tools.csv_records import csv_head, csv_lines
from appliance.features.audit_tools.unrecorded import unknown_names
from appliance.quotas.table import REST_STREAMS

# Make the pages and streams of audit records that a client may read.

_EQUALITY = {
    "type": "object",
    "properties": {
        "key": {"type": "string", "description": "equal in equal records"},
        "reason": {"type": "string", "description": "equal in equal records, or empty if equal to each"},
        "reach": {"type": "integer", "description": "how many of the last rows the record can join"},
        "times": {"type": "integer", "description": "how often the event happened"},
        "value": {"type": "string", "description": "the reason, without the words about repetitions"},
        "began": {"type": "string", "format": "date-time", "description": "time of the first event"},
        "ended": {"type": "string", "format": "date-time", "description": "time of the last event"},
    },
    "required": ["key", "reason", "reach", "times", "value", "began", "ended"],
    "additionalProperties": False,
}
PAGE = {
    "type": "object",
    "properties": {
        "records": {"type": "array", "items": RECORD_REFERENCE},
        "cursor": {
            "type": ["string", "null"],
            "description": "cursor of the next page, or null on the last page",
        },
        "equality": {
            "type": "array",
            "items": _EQUALITY,
            "description": "only with equality=1: for each record, what makes equal ones one row",
        },
        "notes": {
            "type": "array",
            "items": {"type": "string"},
            "description": "only if there are any: an event or category that this version does not record",
        },
    },
    "required": ["records", "cursor"],
    "additionalProperties": False,
}
_STEP = 500


def page_of(
    path: Path,
    wanted: Filter,
    cursor: str | None,
    limit: int,
    bearer: Bearer,
    *,
    newest_first: bool,
    equality: bool = False,
) -> dict[str, Any]:
    """Return a page, whose cursor reveals nothing about hidden records."""
    found: list[LogEntry] = []
    more: str | None = cursor
    count = limit + 1
    while len(found) <= limit:
        entries, more = search(path, wanted, more, count, newest_first=newest_first)
        found += readable(entries, bearer, wanted.text)
        if more is None:
            break
        count = _STEP  # many records may be hidden; large steps skip them faster
    last = str(found[limit - 1].sequence) if len(found) > limit else None
    page: dict[str, Any] = {"records": [as_object(entry) for entry in found[:limit]], "cursor": last}
    if equality:
        page["equality"] = [equality_of(entry.record) for entry in found[:limit]]
    return page | {"notes": notes} if (notes := unknown_names(wanted)) else page


def to_row(entry: LogEntry, *, equality: bool) -> dict[str, Any]:
    return as_object(entry) | ({"equality": equality_of(entry.record)} if equality else {})


# `/v1/audit/summary`: the denials by host. A summary may read much of the log, so only one is made at a time.


def add_summary(router: Routes, audit_log: Path) -> None:
    one = Work("summaries of the audit log", 1)

    @router.get("/summary")
    async def summarise_audit(
        bearer: Viewer,
        since: Annotated[
            str | None, Query(max_length=64, description="1h (ago), a date, or RFC 3339")
        ] = None,
        until: Annotated[str | None, Query(max_length=64, description="before this time")] = None,
        limit: Annotated[int, Query(ge=1, le=LARGEST_SUMMARY, description="largest number of hosts")] = 20,
    ) -> DenialSummary:
        """The denials of each host: number, first and last time, most frequent rules or reasons, and callers."""
        begin, end = (None if time is None else parse_moment(time) for time in (since, until))
        async with one.turn(bearer):
            try:
                return await asyncio.to_thread(
                    summary_of_log, audit_log, Filter(since=begin, until=end), limit
                )
            except LogUnreadableError as error:
                raise ProblemError(503, "log-unreadable", str(error)) from error


_T = TypeVar("_T")
Form = Literal["ndjson", "csv"]
_FORMS: dict[Form, str] = {"ndjson": "application/x-ndjson", "csv": "text/csv; charset=utf-8"}
_POLL_SECONDS = 0.2
_PING_SECONDS = 15
_STREAM_PAGE = 500
_LARGEST_PAGE = 1000
_MAX_NEIGHBOURS = 1000  # the same limit as on the command line

_ONE = {
    "type": "object",
    "properties": {
        "record": RECORD_REFERENCE,
        "before": {"type": "array", "items": RECORD_REFERENCE},
        "after": {"type": "array", "items": RECORD_REFERENCE},
    },
    "required": ["record", "before", "after"],
    "additionalProperties": False,
}


class LogCheckpoints(msgspec.Struct, frozen=True):
    """Signed checkpoints in order; ask again after the last number for more."""

    checkpoints: Annotated[list[SignedCheckpoint], doc("checkpoints, in order")]


def _filter(
    *,
    decision: Annotated[list[Literal["allow", "deny", "would deny", "ask"]] | None, Query()] = None,
    since: Annotated[str | None, Query(max_length=64, description="1h (ago), a date, or RFC 3339")] = None,
    until: Annotated[str | None, Query(max_length=64, description="before this time")] = None,
    host: Annotated[
        str | None,
        Query(
            max_length=256,
            description="the peer: an address, a glob, a network, or a name (of a group, robot, or an enrolled host)",
        ),
    ] = None,
    caller_id: Annotated[
        str | None, Query(max_length=256, description="the name that the peer gave; a glob")
    ] = None,
    resource: Annotated[
        str | None, Query(max_length=256, description="topic, service, call…; a glob")
    ] = None,
    category: Annotated[str | None, Query(max_length=256)] = None,
    event: Annotated[str | None, Query(max_length=256)] = None,
    severity: Annotated[Severity | None, Query(description="this severity or a higher one")] = None,
    rule: Annotated[
        str | None, Query(max_length=256, description="section or key of the rule; a glob")
    ] = None,
    text: Annotated[
        str | None, Query(max_length=256, description="anywhere in names, reason, details")
    ] = None,
    who: Annotated[
        str | None, Query(max_length=256, description="the token's name, or `operator`; a glob")
    ] = None,
    deny: Annotated[bool, Query(description="only denials: the same as decision=deny")] = False,
    topic: Annotated[str | None, Query(max_length=256, description="another word for resource")] = None,
    looks: Annotated[bool, Query(description="0: leave out allowed REST calls that only read")] = True,
) -> Filter:
    if resource is not None and topic is not None:
        raise ProblemError(422, "bad-input", "resource and topic mean the same: give one")
    return Filter(
        decision=tuple(dict.fromkeys([*(decision or ()), *(["deny"] if deny else [])])),
        since=None if since is None else parse_moment(since),
        until=None if until is None else parse_moment(until),
        host=host,
        caller_id=caller_id,
        resource=resource if topic is None else topic,
        category=category,
        event=event,
        severity=severity,
        rule=rule,
        text=text,
        who=who,
        without_looks=not looks,
    )


Wanted = Annotated[Filter, Depends(_filter)]
Limit = Annotated[int, Query(ge=1, le=_LARGEST_PAGE)]
WithEquality = Annotated[bool, Query(description="1: also what makes equal records one row")]


def _json(schema: dict[str, object]) -> Responses:
    return {200: {"description": "OK", "content": {"application/json": {"schema": schema}}}}


def routes(services: Services) -> Routes:
    router = Routes(prefix="/v1/audit", tags=["audit"])
    desk = LogReader(services)
    add_summary(router, services.audit_log)  # before /v1/audit/{record_id}
    _add_searches(router, services, desk)
    _add_proofs(router, services, desk)
    _add_one(router, desk)
    return router


def _add_searches(router: Routes, services: Services, desk: LogReader) -> None:
    streams = Streams(REST_STREAMS, services.settings.api_limits.streams)

    @router.get("", responses=_json(PAGE))
    async def search_audit(
        bearer: Viewer,
        wanted: Wanted,
        *,
        cursor: Annotated[str | None, Query(max_length=18, description="cursor of the previous page")] = None,
        limit: Limit = 100,
        order: Annotated[Literal["newest", "oldest"], Query(description="order of the records")] = "newest",
        equality: WithEquality = False,
    ) -> JSONResponse:
        """Records that match, a page at a time; for viewers without contents of messages (`detail.withheld`)."""
        newest = order == "newest"
        wanted = await desk.resolve_names(bearer, wanted)
        return JSONResponse(
            await desk.read(
                bearer,
                page_of,
                desk.path,
                wanted,
                cursor,
                limit,
                bearer,
                newest_first=newest,
                equality=equality,
            )
        )

    @router.get("/stream", responses=file("text/event-stream", "Events `record`."), response_class=Response)
    async def follow_audit(
        request: Request,
        bearer: Viewer,
        wanted: Wanted,
        *,
        after: Annotated[
            int | None, Query(ge=0, le=10**18, description="start after the record with this sequence")
        ] = None,
        last_event_id: Annotated[str | None, Header(alias="Last-Event-ID", pattern="^[0-9]{1,18}$")] = None,
        equality: WithEquality = False,
    ) -> Response:
        """Records as they are made (server-sent events): each is an event `record`, its id the sequence.

        The stream ends when the token expires. A browser that reconnects continues after the last record it
        got.
        """
        wanted = await desk.resolve_names(bearer, wanted)
        start = int(last_event_id) if last_event_id is not None else after
        follower = await desk.read(bearer, Follower, desk.path, wanted, start)
        give_back = streams.take(bearer, "clients follow the audit log")
        following = _follow(
            services, desk, follower, bearer, wanted.text, peer=peer_of(request), equality=equality
        )
        return StreamResponse(EventSourceResponse(following, ping=_PING_SECONDS), give_back)


def _add_proofs(router: Routes, services: Services, desk: LogReader) -> None:
    verification = Work("verifications", 1)

    @router.get("/verify")
    async def verify_audit(bearer: Operator) -> Verification:
        """Prove that the log is complete and unchanged; for operators, one at a time.

        The checkpoints of the signer are not compared; `rosrv audit verify` on the machine also does that.
        """
        async with verification.turn(bearer):
            return await desk.in_thread(verify, desk.path)

    @router.get("/checkpoints")
    async def audit_checkpoints(
        bearer: Viewer,
        after: Annotated[int, Query(ge=0, le=10**18, description="only records with a greater number")] = 0,
        limit: Limit = 1000,
    ) -> LogCheckpoints:
        """Signed checkpoints to keep on another machine, for `rosrv audit verify --checkpoints`."""
        return LogCheckpoints(await desk.read(bearer, signed_checkpoints, desk.path, after, limit))

    @router.get(
        "/export",
        responses=file("application/x-ndjson", "One record per line, or with `format=csv` as CSV."),
        response_class=Response,
    )
    async def export_audit(
        bearer: Viewer, wanted: Wanted, form: Annotated[Form, Query(alias="format")] = "ndjson"
    ) -> Response:
        """Return all records that match, oldest first, one JSON object a line, or as CSV.

        Each has in `chain` its place in the hash chain, as far as a signed checkpoint. Viewers get records
        without contents of messages and without `chain`, because only complete records can be proven.
        """
        wanted = await desk.resolve_names(bearer, wanted)
        exported = _as_csv if form == "csv" else _export
        found = await desk.read(bearer, exported, desk.path, wanted, bearer, services.settings.name)
        give_back = services.exports.take(bearer, "exports")
        return StreamResponse(StreamingResponse(in_thread(_join(found)), media_type=_FORMS[form]), give_back)


def _add_one(router: Routes, desk: LogReader) -> None:
    @router.get("/{record_id}", responses=_json(_ONE) | UNKNOWN)
    async def audit_record(
        bearer: Viewer, record_id: OneRecord, neighbours: Annotated[int, Query(ge=0, le=_MAX_NEIGHBOURS)] = 5
    ) -> JSONResponse:
        """One record (by id, or by sequence), and what the same host or caller did around it."""
        shown = await desk.record(bearer, record_id, neighbours)
        around = {"before": shown.before, "after": shown.after}
        answer = {
            name: [as_object(readable_by(one, bearer)) for one in some] for name, some in around.items()
        }
        return JSONResponse({"record": as_object(readable_by(shown.entry, bearer)), **answer})


async def _follow(
    services: Services,
    desk: LogReader,
    follower: Follower,
    bearer: Bearer,
    text: str | None,
    *,
    peer: str,
    equality: bool,
) -> AsyncIterator[ServerSentEvent]:
    while not services.stopping.is_set():
        if reason := services.doorkeeper.end_of(bearer, peer):
            yield ServerSentEvent(event="end", data=json.dumps({"reason": reason}))
            return
        entries = await desk.in_thread(follower.poll, _STREAM_PAGE)
        for entry in readable(entries, bearer, text):
            yield ServerSentEvent(
                event="record", id=str(entry.sequence), data=_as_line(to_row(entry, equality=equality))
            )
        if not entries:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_POLL_SECONDS):
                    await services.stopping.wait()


def _export(path: Path, wanted: Filter, bearer: Bearer, robot: str) -> Iterator[str]:
    if reads_contents(bearer):
        return _start(evidence_line(*record, robot) for record in evidence(path, wanted))
    shown = (readable([entry], bearer, wanted.text) for entry in export(path, wanted))
    name = {"robot": robot} if robot else {}
    return _start(_as_line(as_object(entry) | name) for entries in shown for entry in entries)


def _as_csv(path: Path, wanted: Filter, bearer: Bearer, _robot: str) -> Iterator[str]:
    shown = (entry for found in export(path, wanted) for entry in readable([found], bearer, wanted.text))
    return _start(itertools.chain([csv_head()], (line for _sequence, line in csv_lines(shown))))


def _start(entries: Iterator[_T]) -> Iterator[_T]:
    first = next(entries, None)
    return iter(()) if first is None else itertools.chain((first,), entries)


def _join(lines: Iterator[str]) -> Iterator[str]:
    while piece := "".join(f"{line}\n" for line in itertools.islice(lines, _STREAM_PAGE)):
        yield piece


def _as_line(record: dict[str, object]) -> str:
    return json.dumps(record, separators=(",", ":"))
