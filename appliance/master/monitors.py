"""The specifications in force and the switches of their monitors: loading, revisions, what the relay is told.

The folder is the baseline and only read; what is loaded, replaced or removed while the robot runs is a revision in
the store and survives a restart. New specifications are compiled before anything changes; bad ones change nothing
and say everything that is wrong with them. The relay compiles them again and has the last word.

Switches survive restarts, too: a monitor that nobody has switched is enabled or not as `--enable` says.
"""

import asyncio
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import structlog

from appliance.audit.record import Severity
from appliance.channel import messages
from appliance.master.observed import MonitorRecords
from appliance.master.recorder import Recorder
from appliance.master.specifications import (
    Checked,
    Sources,
    SpecificationsRefusedError,
    check,
    read_folder,
)
from appliance.store.state import MonitorRevisionRow, StateStore

_log = structlog.get_logger()
_DISK = "disk"
_SWITCHES = "monitor switches"
_RELAY_SECONDS = 15.0


class UnknownMonitorError(Exception):
    """There is no monitor, or file, of a name; the text says which there are."""


class MonitorsChangedError(Exception):
    """Another revision came into force than the one a change was meant for; the text says which."""

    def __init__(self, expected: int, found: int) -> None:
        super().__init__(
            f"revision {found} of the specifications is in force, not {expected}: look at it first"
        )


@dataclass(frozen=True, slots=True)
class Replaced:
    """What a load did: the revision in force, the one before, files added, changed and removed, the lint."""

    revision: int
    replaced: int
    added: list[str]
    changed: list[str]
    removed: list[str]
    warnings: list[str]


class Monitors:
    """Keeps specifications and switches.

    `send(message)` tells the relay, and says whether one is there; `published()` is called when monitors may publish
    other topics. Changes are made one at a time.
    """

    def __init__(
        self,
        folder: Path | None,
        enable: str,
        store: StateStore,
        recorder: Recorder,
        *,
        on_fault: Literal["drop", "pass"] = "drop",
    ) -> None:
        self.folder = folder
        self._enable = enable
        self._store = store
        self._recorder = recorder
        self._on_fault: Literal["drop", "pass"] = on_fault
        self._switches: dict[str, bool] = {}
        self._answers: dict[int, asyncio.Future[list[str]]] = {}
        self._changing = asyncio.Lock()
        self._relay_known = False
        self._fresh = False
        self.revision = 0
        self.sources = Sources()
        self.checked = Checked()
        self.who, self.note, self.loaded = _DISK, "", 0.0
        self.refused: list[str] = []
        self.held: set[str] = set()
        self.rows: dict[str, messages.MonitorRow] = {}
        self.records = MonitorRecords(recorder, lambda topic, data: self.checked.fields(topic, data))  # noqa: PLW0108 - of whatever is in force then
        self.send: Callable[[messages.Message], bool] = lambda message: False  # noqa: ARG005 - set when wired
        self.published: Callable[[], None] = lambda: None

    # --- start ---

    def start(self, *, restarted: bool) -> None:
        """Bring specifications into force at start. Raises `SpecificationsRefusedError`.

        As with the policy: after a crash of control those that were in force; at the appliance's start the folder's,
        unless an operator's own revision was in force when it stopped.
        """
        self._relay_known = restarted
        self._switches = json.loads(self._store.settings().get(_SWITCHES, "{}"))
        last = self._store.monitor_revision()
        if last is not None and (restarted or last.who != _DISK):
            sources = Sources(**json.loads(last.sources))
            self._enforce(sources, check(sources), last)
        else:
            sources = self._read()
            checked = check(sources)
            if last is not None and Sources(**json.loads(last.sources)) == sources:
                self._enforce(sources, checked, last)
            elif sources.files or last is not None:
                self._keep(sources, checked, who=_DISK, note="read at start")
        unknown = sorted(self._named() - self.checked.monitors.keys())
        if unknown and self.who == _DISK and not restarted:
            raise SpecificationsRefusedError([f"--enable: {self._unknown(unknown)}"])
        if unknown:  # it was removed while the robot ran
            _log.warning("--enable names monitors that are not loaded", monitors=unknown)

    # --- looking ---

    @property
    def differs_from_folder(self) -> bool:
        """Whether what is in force is something else than the folder has now."""
        try:
            return self._read() != self.sources
        except SpecificationsRefusedError:
            return True

    def enabled(self, name: str) -> bool:
        """Whether a monitor's events happen."""
        default = self._enable == "all" or (self._enable != "none" and name in self._named())
        return self._switches.get(name, default)

    def names(self) -> list[str]:
        """All monitors, in the order in which they see messages."""
        return list(self.checked.monitors)

    def statement(self) -> messages.SpecificationsStated:
        """What a relay is told before anything else; one that follows another must hold what is to be held."""
        restarted, self._relay_known = self._relay_known, True
        self._fresh = restarted
        return self._statement(restarted)

    # --- changing ---

    async def load(
        self,
        files: dict[str, str],
        definitions: dict[str, str],
        *,
        who: str,
        note: str,
        expected: int | None = None,
    ) -> Replaced:
        """Add these files, or replace those of the same name. Raises `SpecificationsRefusedError`."""
        async with self._changing:
            self._expect(expected)
            return await self._change(self.sources.with_files(files, definitions), who, who, note or "loaded")

    async def reload(self, *, who: str, expected: int | None = None) -> Replaced:
        """Take what the folder has now. Raises `SpecificationsRefusedError`."""
        async with self._changing:
            self._expect(expected)
            sources = await asyncio.to_thread(self._read)
            return await self._change(sources, _DISK, who, "reloaded from disk")

    async def remove(self, names: list[str], *, who: str, expected: int | None = None) -> Replaced:
        """Remove files, by their names or those of their monitors.

        Raises `UnknownMonitorError`, and `SpecificationsRefusedError` where others use their variables, or a file has
        other monitors as well.
        """
        async with self._changing:
            self._expect(expected)
            owners = self.checked.monitors
            known = set(self.sources.files) | set(owners)
            unknown = [name for name in names if name not in known]
            if unknown:
                raise UnknownMonitorError(self._unknown(unknown))
            files = {owners.get(name, name) for name in names}
            left = sorted(
                one for one, file in owners.items() if file in files and not {one, file} & set(names)
            )
            if left:
                text = f"{', '.join(left)} would go, too: they are in the same file; name the file, or load it without"
                raise SpecificationsRefusedError([text])
            return await self._change(
                self.sources.without(files), who, who, f"removed {', '.join(sorted(files))}"
            )

    async def switch(
        self, names: list[str], enabled: bool, *, who: str, expected: int | None = None
    ) -> list[str]:
        """Enable or disable monitors; those that were not so already. Raises `UnknownMonitorError`."""
        async with self._changing:
            self._expect(expected)
            self._all_known(names)
            changed = [name for name in dict.fromkeys(names) if self.enabled(name) is not enabled]
            for name in changed:
                self._switches[name] = enabled
                self.send(messages.MonitorSwitched(name, enabled))
                word = "enabled" if enabled else "disabled"
                self._recorder.happened(
                    f"monitor {word}",
                    f"{name} is {word}",
                    severity=Severity.NOTICE,
                    category="monitor",
                    resource=name,
                    who=who,
                )
            if changed:
                self._store.save_setting(_SWITCHES, json.dumps(self._switches))
                await self._store.settled()
            return changed

    async def resume(self, names: list[str], *, who: str, expected: int | None = None) -> list[str]:
        """Let the topics of held monitors go on; which were held. Raises `UnknownMonitorError`."""
        self._expect(expected)
        self._all_known(names)
        held = [name for name in dict.fromkeys(names) if name in self.held]
        for name in held:
            self.send(messages.MonitorResumed(name))
            self.held.discard(name)
            self._recorder.happened(
                "monitor resumed",
                f"the topics of {name} go on",
                severity=Severity.NOTICE,
                category="monitor",
                resource=name,
                who=who,
            )
        return held

    # --- what the relay says ---

    def received(self, message: messages.Message) -> None:
        """A message of the relay about monitors."""
        match message:
            case messages.SpecificationsTaken(revision, began, held):
                self._taken(revision, began, held)
            case messages.SpecificationsRefused(revision, findings):
                self._relay_refused(revision, findings)
            case messages.MonitorsCounted(rows):
                self.rows = {row.name: row for row in rows}
            case messages.MonitorsReported(events, lost):
                self.records.reported(events, lost)

    def _taken(self, revision: int, began: list[str], held: list[str]) -> None:
        self.refused = []
        self.held = set(held)
        if self._fresh and began:
            self._recorder.happened(
                "monitors restarted",
                f"a new relay process: {', '.join(began)} began in the initial state"
                + (f"; {', '.join(held)} hold their topics until resumed" if held else ""),
                severity=Severity.ALARM,
                category="monitor",
                resource="",
                monitors=began,
                held=held,
            )
        self._fresh = False
        self._answer(revision, [])

    def _relay_refused(self, revision: int, findings: list[str]) -> None:
        if revision == self.revision:
            self.refused = findings
        self._recorder.happened(
            "specifications refused",
            f"the relay does not take revision {revision}: {findings[0] if findings else ''}",
            severity=Severity.ALARM,
            findings=findings,
        )
        self._answer(revision, findings or ["the relay gives no reason"])

    def _answer(self, revision: int, findings: list[str]) -> None:
        waiting = self._answers.pop(revision, None)
        if waiting is not None and not waiting.done():
            waiting.set_result(findings)

    # --- inside ---

    def _read(self) -> Sources:
        return read_folder(self.folder) if self.folder is not None else Sources()

    def _named(self) -> set[str]:
        return set() if self._enable in {"all", "none"} else {one.strip() for one in self._enable.split(",")}

    def _unknown(self, names: list[str]) -> str:
        known = ", ".join(self.checked.monitors) or "none is loaded"
        return f"no monitor is named {', '.join(names)}; there are: {known}"

    def _all_known(self, names: list[str]) -> None:
        unknown = [name for name in names if name not in self.checked.monitors]
        if unknown:
            raise UnknownMonitorError(self._unknown(unknown))

    def _expect(self, expected: int | None) -> None:
        if expected is not None and expected != self.revision:
            raise MonitorsChangedError(expected, self.revision)

    def _statement(self, restarted: bool) -> messages.SpecificationsStated:
        return messages.SpecificationsStated(
            self.revision,
            list(self.sources.files.items()),
            self.sources.definitions,
            {name: self.enabled(name) for name in self.checked.monitors},
            restarted,
            self._on_fault,
        )

    async def _change(self, sources: Sources, keeper: str, who: str, note: str) -> Replaced:
        before, previous = self.revision, self.sources
        try:
            checked = await asyncio.to_thread(check, sources)
            await self._try(sources, checked)
        except SpecificationsRefusedError as error:
            self._recorder.happened(
                "specifications refused",
                f"revision {self.revision} stays in force: {error.findings[0]}",
                severity=Severity.WARNING,
                findings=error.findings[:100],
                who=who,
            )
            raise
        self._keep(sources, checked, who=keeper, note=note, by=who, before=previous)
        self.send(self._statement(False))  # a relay that came in between was told the revision before
        await self._store.settled()
        self.published()
        added, changed, removed = sources.difference(previous)
        return Replaced(self.revision, before, added, changed, removed, list(checked.warnings))

    async def _try(self, sources: Sources, checked: Checked) -> None:
        """Have the relay take them. Without a relay they come into force when there is one."""
        number = self.revision + 1
        answer = asyncio.get_running_loop().create_future()
        self._answers[number] = answer
        statement = messages.SpecificationsStated(
            number,
            list(sources.files.items()),
            sources.definitions,
            {name: self.enabled(name) for name in checked.monitors},
            False,
            self._on_fault,
        )
        try:
            if not self.send(statement):
                return
            findings = await asyncio.wait_for(answer, _RELAY_SECONDS)
        except TimeoutError:
            self.send(self._statement(False))
            text = f"the relay does not answer within {_RELAY_SECONDS:g} s; try again"
            raise SpecificationsRefusedError([text]) from None
        finally:
            self._answers.pop(number, None)
        if findings:
            raise SpecificationsRefusedError(findings)

    def _keep(
        self,
        sources: Sources,
        checked: Checked,
        *,
        who: str,
        note: str,
        by: str | None = None,
        before: Sources | None = None,
    ) -> None:
        text = json.dumps({"files": sources.files, "definitions": sources.definitions})
        row = MonitorRevisionRow(self.revision + 1, text, time.time(), who, note)
        last = self._store.monitor_revision()
        if before is None and last is not None:
            row = MonitorRevisionRow(last.revision + 1, text, time.time(), who, note)
            before = Sources(**json.loads(last.sources))
        self._store.save_monitor_revision(row)
        self._enforce(sources, checked, row)
        added, changed, removed = sources.difference(before or Sources())
        self._recorder.happened(
            "specifications loaded",
            f"revision {row.revision} of the specifications is in force: {note}",
            severity=Severity.NOTICE,
            category="monitor",
            resource="",
            who=by or who,
            revision_of_specifications=row.revision,
            monitors=list(checked.monitors),
            added=added,
            changed=changed,
            removed=removed,
            warnings=list(checked.warnings)[:100],
        )

    def _enforce(self, sources: Sources, checked: Checked, row: MonitorRevisionRow) -> None:
        self.sources, self.checked, self.revision = sources, checked, row.revision
        self.who, self.note, self.loaded = row.who, row.note, row.loaded
