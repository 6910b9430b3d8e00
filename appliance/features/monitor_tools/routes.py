"""Routes of `/v1/monitors`: monitors, their specifications and history, and changes with answers of their own."""

import asyncio
from functools import cached_property
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Annotated

from fastapi import Path, Query, Response
from msgspec.structs import asdict

from appliance.api.front.access import Bearer
from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import Viewer, ask, reads_contents
from appliance.api.front.routing import Responses, Routes, Tagged, file, with_tag
from appliance.api.front.services import Services
from appliance.api.routes.log_reader import LogReader
from appliance.api.routes.operation_routes import Answer, AnsweringRoutes, OperationCall
from appliance.audit.log.record_format import LogEntry, rfc3339, without_contents
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.channel import admin
from appliance.channel.answers.monitor_answers import Monitors, MonitorState, Replaced, findings_of
from appliance.features.monitor_tools.monitor_judgement import Described, Happened, History, Monitor

if TYPE_CHECKING:
    from appliance.features.monitor_tools.monitor_judgement import Compiler

UNKNOWN: Responses = {404: {"description": "There is no such monitor, or revision."}}
_PICTURE = file("image/svg+xml", "OK")
OneName = Annotated[
    str, Path(min_length=1, max_length=256, description="name of the monitor", examples=["censor"])
]


class _Looking:
    """Reads and compiles the specifications in force, a limited number at once."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self.desk = LogReader(services)

    @cached_property
    def compiler(self) -> "Compiler":
        from appliance.features.monitor_tools.monitor_judgement import Compiler  # noqa: PLC0415  150 modules

        return Compiler()

    async def state(self, bearer: Bearer, name: str) -> tuple[Monitors, MonitorState]:
        """Return the specifications, and the state of a monitor. Raises `ProblemError` (404)."""
        loaded = await ask(self._services.control, admin.MonitorsWanted(texts=True), bearer)
        row = next((monitor for monitor in loaded.monitors if monitor.name == name), None)
        if row is None:
            raise unknown_monitor(name, loaded)
        return loaded, row

    async def describe(self, bearer: Bearer, loaded: Monitors, name: str) -> Described:
        async with self._services.judging.turn(bearer):
            return await asyncio.to_thread(self.compiler.describe, loaded, name)

    async def picture(self, bearer: Bearer, loaded: Monitors, name: str) -> str | None:
        async with self._services.judging.turn(bearer):
            return await asyncio.to_thread(self.compiler.picture, loaded, name)


def unknown_monitor(name: str, loaded: Monitors) -> ProblemError:
    names = ", ".join(monitor.name for monitor in loaded.monitors)
    known = f"there are: {names}" if names else "none is loaded"
    return ProblemError(404, "unknown", f"no monitor is named {name}; {known}")


def routes(services: Services) -> Routes:
    router = AnsweringRoutes(_ANSWERS, prefix="/v1/monitors", tags=["monitors"])
    looking = _Looking(services)

    @router.get("/{name}", responses=UNKNOWN)
    async def monitor(name: OneName, bearer: Viewer) -> Tagged[Monitor]:
        """One monitor: state, counters, the text of its file, its events and properties."""
        loaded, state = await looking.state(bearer, name)
        found = await looking.describe(bearer, loaded, name)
        shown = Monitor(
            **asdict(state),
            revision=loaded.revision,
            tag=loaded.tag,
            text=(loaded.files or {})[state.file],
            alphabet=found.events,
            properties=found.properties,
            warnings=[finding for finding in findings_of(loaded.warnings) if finding.file == state.file],
            uses=found.uses,
            hold=found.hold,
        )
        return with_tag(shown)

    @router.get("/{name}/picture", responses=_PICTURE | UNKNOWN, response_class=Response)
    async def monitor_picture(name: OneName, bearer: Viewer) -> Response:
        """Return the automata of its properties (SVG); 404 when it has none that is finite."""
        loaded, _state = await looking.state(bearer, name)
        drawn = await looking.picture(bearer, loaded, name)
        if drawn is None:
            raise ProblemError(404, "unknown", f"{name} has no property whose monitor is a finite automaton")
        return Response(drawn, media_type="image/svg+xml")

    @router.get("/{name}/history")
    async def monitor_history(
        name: OneName,
        bearer: Viewer,
        cursor: Annotated[str | None, Query(max_length=18, description="cursor of the previous page")] = None,
        limit: Annotated[int, Query(ge=1, le=500)] = 50,
    ) -> History:
        """Return the monitor's latest actions: verdicts, drops, changes, faults, output, switches; from the audit log.

        A monitor that no longer exists also has its history.
        """
        found: list[LogEntry] = await looking.desk.read(
            bearer, records_of, looking.desk.path, name, cursor, limit + 1
        )
        happened = [
            _happened(entry if reads_contents(bearer) else without_contents(entry)) for entry in found[:limit]
        ]
        return History(name, happened, str(found[limit - 1].sequence) if len(found) > limit else None)

    return router


def records_of(path: FilePath, name: str, cursor: str | None, count: int) -> list[LogEntry]:
    entries: list[LogEntry] = []
    more: str | None = cursor
    while len(entries) < count:
        page = search(path, Filter(category="monitor", text=name), more, count)
        entries += [entry for entry in page.entries if _of(entry, name)]
        more = page.cursor
        if more is None:
            break
    return entries[:count]


def _of(entry: LogEntry, name: str) -> bool:
    record = entry.record
    return record.detail.get("monitor") == name or (
        record.event.startswith("monitor ") and record.resource == name
    )


def _happened(entry: LogEntry) -> Happened:
    record, detail = entry.record, entry.record.detail
    category, count = detail.get("category"), detail.get("count")
    return Happened(
        sequence=entry.sequence,
        time=rfc3339(record.time),
        event=record.event,
        resource=record.resource,
        reason=record.reason,
        category=category if isinstance(category, str) else None,
        count=count if isinstance(count, int) else None,
    )


async def _load(call: OperationCall[admin.MonitorLoad | admin.MonitorReplace]) -> Tagged[Replaced]:
    return with_tag(await call.ask(admin.MonitorTry(call.order) if call.dry_run else call.order))


_ANSWERS = {"load_monitors": Answer(_load), "replace_monitor": Answer(_load)}
