"""`/v1/monitors`: look at the monitors, the specifications they are made of, and what they did."""

import asyncio
from pathlib import Path as FilePath
from typing import Annotated, Any

from fastapi import Path, Query, Response
from msgspec.structs import asdict

from appliance.api.access import Bearer
from appliance.api.audit import Desk
from appliance.api.monitor_judgement import Compiler, events_of, picture_of, properties_of
from appliance.api.monitor_models import Happened, History, Monitor
from appliance.api.policy_models import OneRevision
from appliance.api.problems import ProblemError
from appliance.api.route_roles import Viewer, ask, reads_contents
from appliance.api.routing import Responses, Routes, Tagged, file, tagged
from appliance.api.services import Services
from appliance.audit.query import Filter
from appliance.audit.record_format import Entry, rfc3339, without_contents
from appliance.audit.search import search
from appliance.channel.admin import MonitorRevisions, MonitorRevisionWanted, MonitorsWanted
from appliance.channel.answers.monitor_answers import (
    MonitorRevisionList,
    Monitors,
    MonitorState,
    RevisionTexts,
)

UNKNOWN: Responses = {404: {"description": "There is no such monitor, or revision."}}
_PICTURE = file("image/svg+xml", "OK")
OneName = Annotated[str, Path(min_length=1, max_length=256, description="of a monitor", examples=["censor"])]


class _Looking:
    """Reads what is in force and compiles it, so many texts at once."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self.compiler = Compiler()
        self.desk = Desk(services)

    async def state(self, bearer: Bearer, name: str) -> tuple[Monitors, MonitorState]:
        """What is in force, with texts, and the row of a monitor. Raises `ProblemError` (404)."""
        loaded = await ask(self._services.control, MonitorsWanted(texts=True), bearer)
        row = next((monitor for monitor in loaded.monitors if monitor.name == name), None)
        if row is None:
            raise unknown_monitor(name, loaded)
        return loaded, row

    async def compiled(self, loaded: Monitors, name: str) -> Any:
        """A monitor, compiled here."""
        async with self._services.judging:
            return await asyncio.to_thread(self.compiler.monitor, loaded, name)


def unknown_monitor(name: str, loaded: Monitors) -> ProblemError:
    """Why a monitor is not found, and which there are."""
    known = ", ".join(monitor.name for monitor in loaded.monitors) or "none is loaded"
    return ProblemError(404, "unknown", f"no monitor is named {name}; there are: {known}")


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1/monitors", tags=["monitors"])
    looking = _Looking(services)

    @router.get("")
    async def monitors(
        bearer: Viewer,
        texts: Annotated[bool, Query(description="with the texts of the specifications")] = False,
    ) -> Tagged[Monitors]:
        """All monitors with state and counters, and whether they are what the folder has."""
        return tagged(await ask(services.control, MonitorsWanted(texts=texts), bearer))

    @router.get("/revisions", operation_id="monitor_revisions")
    async def revisions(bearer: Viewer) -> MonitorRevisionList:
        """The kept revisions of the specifications, the newest first."""
        return await ask(services.control, MonitorRevisions(), bearer)

    @router.get("/revisions/{revision}", operation_id="monitor_revision", responses=UNKNOWN)
    async def revision_texts(revision: OneRevision, bearer: Viewer) -> RevisionTexts:
        """A kept revision with its texts."""
        return await ask(services.control, MonitorRevisionWanted(revision), bearer)

    @router.get("/{name}", responses=UNKNOWN)
    async def monitor(name: OneName, bearer: Viewer) -> Tagged[Monitor]:
        """One monitor: state, counters, the text of its file, its events and properties."""
        loaded, state = await looking.state(bearer, name)
        found = await looking.compiled(loaded, name)
        shown = Monitor(
            **asdict(state),
            revision=loaded.revision,
            tag=loaded.tag,
            text=(loaded.files or {})[state.file],
            alphabet=events_of(found),
            properties=properties_of(found),
            warnings=looking.compiler.warnings(state.file),
            uses=sorted(found.code.uses),
            hold=found.code.hold,
        )
        return tagged(shown)

    @router.get("/{name}/picture", responses=_PICTURE | UNKNOWN, response_class=Response)
    async def monitor_picture(name: OneName, bearer: Viewer) -> Response:
        """The automata of its properties (SVG); 404 when it has none that is finite."""
        loaded, _state = await looking.state(bearer, name)
        drawn = await asyncio.to_thread(picture_of, await looking.compiled(loaded, name))
        if drawn is None:
            raise ProblemError(404, "unknown", f"{name} has no property whose monitor is a finite automaton")
        return Response(drawn, media_type="image/svg+xml")

    @router.get("/{name}/history")
    async def monitor_history(
        name: OneName,
        bearer: Viewer,
        cursor: Annotated[str | None, Query(max_length=18, description="of the page before")] = None,
        limit: Annotated[int, Query(ge=1, le=500)] = 50,
    ) -> History:
        """What it did last: verdicts, drops, changes, faults, output, switches; from the audit log.

        A monitor that is no longer there has its history, too.
        """
        found: list[Entry] = await looking.desk.read(records_of, looking.desk.path, name, cursor, limit + 1)
        happened = [
            _happened(entry if reads_contents(bearer) else without_contents(entry)) for entry in found[:limit]
        ]
        return History(name, happened, str(found[limit - 1].sequence) if len(found) > limit else None)

    return router


def records_of(path: FilePath, name: str, cursor: str | None, count: int) -> list[Entry]:
    """The last records about a monitor. That others have the word in them does not show in how many there are."""
    found: list[Entry] = []
    more: str | None = cursor
    while len(found) < count:
        page = search(path, Filter(category="monitor", text=name), more, count)
        found += [entry for entry in page.entries if _of(entry, name)]
        more = page.cursor
        if more is None:
            break
    return found[:count]


def _of(entry: Entry, name: str) -> bool:
    """Whether a record is about this monitor, and not about one whose name or topic has that word in it."""
    record = entry.record
    return record.detail.get("monitor") == name or (
        record.event.startswith("monitor ") and record.resource == name
    )


def _happened(entry: Entry) -> Happened:
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
