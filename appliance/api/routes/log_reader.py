"""Read the audit log for routes, in a limited number of threads. The api cannot write the log."""

import asyncio
from collections.abc import Callable, Iterable
from typing import Annotated, ParamSpec, TypeVar

from fastapi import Path

from appliance.api.front.access import Bearer
from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import ask, reads_contents
from appliance.api.front.routing import Responses
from appliance.api.front.services import Services
from appliance.api.routes.named_hosts import has_name, with_networks
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record_format import LogEntry, as_json, without_contents
from appliance.audit.log.schema import json_schema
from appliance.audit.log.signatures import KeyUnreadableError
from appliance.audit.search.query import Filter, FilterError
from appliance.audit.search.search import RecordInContext, show
from appliance.channel.admin import PolicyWanted

_T = TypeVar("_T")
_P = ParamSpec("_P")
RECORD = {key: value for key, value in json_schema().items() if key != "$schema"}
RECORD_REFERENCE = {"$ref": "#/components/schemas/AuditRecord"}
UNKNOWN: Responses = {404: {"description": "There is no such record."}}
OneRecord = Annotated[
    str,
    Path(
        min_length=1,
        max_length=20,
        pattern="^[0-9a-f]+$",
        description="id of a record, or its sequence",
        examples=["812"],
    ),
]


class LogReader:
    """Reads the log in a limited number of threads."""

    def __init__(self, services: Services) -> None:
        self.path = services.audit_log
        self._control = services.control
        self._searches = services.searches

    async def read(
        self, bearer: Bearer, function: Callable[_P, _T], *arguments: _P.args, **named: _P.kwargs
    ) -> _T:
        async with self._searches.turn(bearer):
            return await self.in_thread(function, *arguments, **named)

    async def resolve_names(self, bearer: Bearer, wanted: Filter) -> Filter:
        if not has_name(wanted):
            return wanted
        return await self.in_thread(with_networks, wanted, await ask(self._control, PolicyWanted(), bearer))

    async def record(self, bearer: Bearer, record_id: str, neighbours: int) -> RecordInContext:
        """Return a record with its neighbours. Raises `ProblemError`."""
        shown = await self.read(bearer, show, self.path, record_id, neighbours)
        if shown is None:
            raise ProblemError(
                404, "unknown", f"there is no record {record_id}: rosrv audit search lists records"
            )
        return shown

    async def in_thread(self, function: Callable[_P, _T], *arguments: _P.args, **named: _P.kwargs) -> _T:
        try:
            return await asyncio.to_thread(function, *arguments, **named)
        except FilterError as error:
            raise ProblemError(422, "bad-input", str(error)) from error
        except (LogUnreadableError, KeyUnreadableError) as error:
            raise ProblemError(503, "log-unreadable", str(error)) from error


def readable(entries: Iterable[LogEntry], bearer: Bearer, text: str | None = None) -> list[LogEntry]:
    """Return the records as the client may read them, without those that match `text` only in hidden parts."""
    found = []
    for entry in entries:
        shown = readable_by(entry, bearer)
        if shown is entry or text is None or text.casefold() in as_json(shown).casefold():
            found.append(shown)
    return found


def readable_by(entry: LogEntry, bearer: Bearer) -> LogEntry:
    return entry if reads_contents(bearer) else without_contents(entry)
