"""What operators ask of the monitors."""

from dataclasses import asdict

import msgspec

from appliance.channel import admin
from appliance.channel.answers import monitors as answers
from appliance.channel.answers.status import MonitorsState
from appliance.control.assembly import Parts
from appliance.specifications.monitors import Monitors
from appliance.specifications.monitors import Replaced as Done


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
            folder=str(monitors.folder) if monitors.folder is not None else None,
            differs_from_folder=monitors.differs_from_folder,
            warnings=list(monitors.checked.warnings),
            refused=monitors.refused,
            rv_state=msgspec.convert(self._parts.monitor_calls.rv_state(), answers.RvState),
            monitors=states_of(monitors),
            files=monitors.sources.files if request.texts else None,
            definitions=monitors.sources.definitions if request.texts else None,
        )

    async def load(self, request: admin.MonitorLoad, who: str) -> answers.Replaced:
        """Add or replace files of specifications."""
        done = await self._monitors.load(
            request.files, request.definitions, who=who, note=request.note, expected=request.expected
        )
        return self._replaced(done)

    async def replace(self, request: admin.MonitorReplace, who: str) -> answers.Replaced:
        """Put a text in the place of a monitor's file."""
        files = {self._monitors.file_of(request.name): request.text}
        done = await self._monitors.load(
            files, request.definitions, who=who, note=request.note, expected=request.expected
        )
        return self._replaced(done)

    async def reload(self, request: admin.MonitorReload, who: str) -> answers.Replaced:
        """Take what the folder has."""
        done = await self._monitors.reload(who=who, expected=request.expected, prune=request.prune)
        return self._replaced(done)

    async def remove(self, request: admin.MonitorRemove, who: str) -> answers.Replaced:
        """Remove specifications."""
        return self._replaced(await self._monitors.remove(request.names, who=who, expected=request.expected))

    async def switch(self, request: admin.MonitorSwitch, who: str) -> answers.Switched:
        """Enable or disable monitors."""
        names = await self._monitors.switch(
            request.names, request.enabled, who=who, expected=request.expected
        )
        return answers.Switched(names, self._monitors.revision, self._monitors.tag)

    async def resume(self, request: admin.MonitorResume, who: str) -> answers.Switched:
        """Let topics go on that monitors hold."""
        names = await self._monitors.resume(request.names, who=who, expected=request.expected)
        return answers.Switched(names, self._monitors.revision, self._monitors.tag)

    def _replaced(self, done: Done) -> answers.Replaced:
        return answers.Replaced(**asdict(done), tag=self._monitors.tag)


def monitors_status(monitors: Monitors) -> MonitorsState:
    """The few words of `rosrv status`."""
    rows = states_of(monitors)
    return MonitorsState(
        revision=monitors.revision,
        tag=monitors.tag,
        loaded=len(rows),
        enabled=sum(row.enabled for row in rows),
        held=[row.name for row in rows if row.held],
        failing=[row.name for row in rows if row.failing],
        refused=monitors.refused,
        who=monitors.who,
        differs_from_folder=monitors.differs_from_folder,
    )


def states_of(monitors: Monitors) -> list[answers.MonitorState]:
    """Every monitor, in the order in which they see messages."""
    return [_state(monitors, name) for name in monitors.names()]


def _state(monitors: Monitors, name: str) -> answers.MonitorState:
    row, checked = monitors.rows.get(name), monitors.checked
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
        drops=row.drops if row is not None else 0,
        changes=row.changes if row is not None else 0,
        faults=row.faults if row is not None else 0,
    )
