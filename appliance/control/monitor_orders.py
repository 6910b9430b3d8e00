"""What operators ask of the monitors."""

from typing import Any

import msgspec

from appliance.channel import admin
from appliance.channel.answers import monitors as answers
from appliance.channel.answers.status import MonitorsState
from appliance.channel.messages import Approach, MarginRow
from appliance.control.assembly import Parts
from appliance.control.errors import UnknownThingError
from appliance.rosmop.positions import line_of
from appliance.specifications.files import Sources
from appliance.specifications.monitors import Monitors, sources_of
from appliance.store.state import MonitorRevisionRow


class MonitorOrders:
    """Each method answers the request that it takes.

    They raise `SpecificationsRefusedError`, `MonitorsChangedError`, `UnknownMonitorError`.
    """

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self._monitors = parts.monitors

    async def listed(self, request: admin.MonitorsWanted) -> answers.Monitors:
        """All monitors with state and counters; with `texts`, the specifications too."""
        monitors = self._monitors
        return answers.Monitors(
            revision=monitors.revision,
            tag=monitors.tag,
            who=monitors.who,
            note=monitors.note,
            loaded=monitors.loaded,
            confirm_by=monitors.confirm_by,
            folder=str(monitors.folder) if monitors.folder is not None else None,
            differs_from_folder=monitors.differs_from_folder,
            warnings=list(monitors.checked.warnings),
            refused=monitors.refused,
            site_keys=list(monitors.site_keys),
            rv_state=msgspec.convert(self._parts.monitor_calls.rv_state(), answers.RvState),
            monitors=states_of(monitors),
            files=monitors.sources.files if request.texts else None,
            definitions=monitors.sources.definitions if request.texts else None,
            signatures=monitors.sources.signatures if request.texts else None,
        )

    async def load(self, request: admin.MonitorLoad, who: str) -> answers.Replaced:
        """Add or replace files of specifications."""
        return await self._monitors.load(
            Sources(request.files, request.definitions, request.signatures),
            who=who,
            note=request.note,
            expected=request.expected,
            confirm_within=request.confirm_within,
        )

    async def replace(self, request: admin.MonitorReplace, who: str) -> answers.Replaced:
        """Put a text in the place of a monitor's file."""
        file = self._monitors.file_of(request.name)
        load = admin.MonitorLoad(
            {file: request.text},
            request.definitions,
            request.note,
            request.expected,
            request.confirm_within,
            {**request.signatures, file: request.signature},
        )
        return await self.load(load, who)

    async def reload(self, request: admin.MonitorReload, who: str) -> answers.Replaced:
        """Take what the folder has."""
        return await self._monitors.reload(
            who=who, expected=request.expected, prune=request.prune, confirm_within=request.confirm_within
        )

    async def remove(self, request: admin.MonitorRemove, who: str) -> answers.Replaced:
        """Remove specifications."""
        return await self._monitors.remove(
            request.names, who=who, expected=request.expected, confirm_within=request.confirm_within
        )

    async def roll_back(self, request: admin.MonitorRollback, who: str) -> answers.Replaced:
        """Bring a kept revision into force."""
        return await self._monitors.rollback(request.revision, who=who, expected=request.expected)

    async def confirm(self, request: admin.MonitorConfirm, who: str) -> answers.MonitorsConfirmed:
        """Keep a change that would go back by itself."""
        confirmed = await self._monitors.confirm(who=who, expected=request.expected)
        return answers.MonitorsConfirmed(confirmed, self._monitors.revision, self._monitors.tag)

    async def revisions(self, _request: admin.MonitorRevisions) -> answers.MonitorRevisionList:
        """The kept revisions."""
        rows = await self._monitors.revisions()
        return answers.MonitorRevisionList([answers.MonitorRevision(**self._revision(row)) for row in rows])

    async def revision(self, request: admin.MonitorRevisionWanted) -> answers.RevisionTexts:
        """A revision with its texts. Raises `UnknownThingError`."""
        for row in await self._monitors.revisions():
            if row.revision == request.revision:
                sources = sources_of(row)
                return answers.RevisionTexts(**self._revision(row), **msgspec.structs.asdict(sources))
        raise UnknownThingError(f"there is no revision {request.revision} of the specifications")

    def _revision(self, row: MonitorRevisionRow) -> dict[str, Any]:
        """The fields of `MonitorRevision`."""
        return {
            "revision": row.revision,
            "loaded": row.loaded,
            "who": row.who,
            "note": row.note,
            "in_force": row.revision == self._monitors.revision,
            "names": list(sources_of(row).files),
        }

    async def switch(self, request: admin.MonitorSwitch, who: str) -> answers.Switched:
        """Enable or disable monitors."""
        names = await self._monitors.switch(
            request.names, request.enabled, who=who, expected=request.expected
        )
        return answers.Switched(names, self._monitors.revision, self._monitors.tag)

    async def trial(self, request: admin.MonitorTrial, who: str) -> answers.Switched:
        """Put monitors on trial, or bring them into force."""
        order = self._monitors.try_out if request.trial else self._monitors.promote
        names = await order(request.names, who=who, expected=request.expected)
        began = self._monitors.began(names)
        return answers.Switched(names, self._monitors.revision, self._monitors.tag, began)

    async def resume(self, request: admin.MonitorResume, who: str) -> answers.Switched:
        """Let topics go on that monitors hold."""
        names = await self._monitors.resume(request.names, who=who, expected=request.expected)
        return answers.Switched(names, self._monitors.revision, self._monitors.tag)


def monitors_status(monitors: Monitors) -> MonitorsState:
    """The few words of `rosrv status`."""
    rows = states_of(monitors)
    return MonitorsState(
        revision=monitors.revision,
        tag=monitors.tag,
        loaded=len(rows),
        enabled=sum(row.enabled for row in rows),
        held=[row.name for row in rows if row.held],
        failing=[row.name for row in rows if row.failing and not row.trial],
        refused=monitors.refused,
        who=monitors.who,
        differs_from_folder=monitors.differs_from_folder,
        confirm_by=monitors.confirm_by,
        trials=[row.name for row in rows if row.trial],
    )


def states_of(monitors: Monitors) -> list[answers.MonitorState]:
    """Every monitor, in the order in which they see messages."""
    return [_state(monitors, name) for name in monitors.names()]


def _state(monitors: Monitors, name: str) -> answers.MonitorState:
    row, checked = monitors.rows.get(name), monitors.checked
    drops, changes = (row.drops, row.changes) if row is not None else (0, 0)
    tried = row is not None and row.trial
    return answers.MonitorState(
        name=name,
        file=checked.monitors[name],
        enabled=monitors.enabled(name),
        held=name in monitors.held,
        failing=row is not None and row.failing,
        topics=sorted(checked.topics[name]),
        services=sorted(checked.services[name]),
        events=row.events if row is not None else 0,
        verdicts=row.verdicts if row is not None else 0,
        drops=0 if tried else drops,
        changes=0 if tried else changes,
        faults=row.faults if row is not None else 0,
        certificates=checked.certificates.get(name, []),
        trial=monitors.on_trial(name),
        would_drop=drops if tried else 0,
        would_change=changes if tried else 0,
        missed=row.missed if row is not None else 0,
        slices=row.slices if row is not None else 0,
        slice_limit=row.slice_limit if row is not None else 0,
        margins=[]
        if row is None
        else [_margin(each, monitors.sources.files.get(row.file, "")) for each in row.margins],
    )


def _margin(row: MarginRow, text: str) -> answers.MonitorMargin:
    def approach(sides: Approach) -> answers.Approach:
        reached = None if row.threshold is None else (sides.right, sides.left)[row.threshold]
        return answers.Approach(sides.time / 1e9, sides.left, sides.right, sides.distance, reached)

    today = approach(row.today) if row.today is not None else None
    return answers.MonitorMargin(
        row.line, row.column, line_of(text, row.line), row.holds, approach(row.load), today
    )
