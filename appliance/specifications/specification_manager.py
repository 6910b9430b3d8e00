"""The specifications in force: load, switch, roll back, and answer operators.

1. The appliance never writes to the folder of specifications. Changes are revisions in the store; revisions and
   switches survive a restart.
2. The value in force is immutable. An order makes the next one (`in_force.py`), which is checked and judged
   (`judgement.py`), rolled out and stored. Then it takes the place of the present one.
3. An error before that changes nothing: relays that have the next value get the present one again, and the store gets
   its rows and limits again. A value that was queued just before the store closes may remain stored.
4. A return that is due, as that of an unconfirmed change, does not wait for the store: a full disk must not leave a
   protection off. After a restart, the return is due again.
5. A load or switch of other monitors never takes an existing monitor out of force.
6. Files that are not in the folder stay in force unless a reload prunes, so a missing file ends no protection.
7. Each revision is stored with its last switches and constants. A rollback gives them to monitors that return; that of
   an unconfirmed change to all, except for what operators ordered since. It undoes later revisions as well: only a
   confirmation, and a rollback to a revision before it, end the time to confirm.
8. Each change gets a new tag, which never repeats; a change that expects another tag is refused.
"""

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import structlog

from appliance.base import clock
from appliance.base.actors import DISK, UNCONFIRMED
from appliance.base.withdrawal import take_effect
from appliance.channel import admin, messages
from appliance.channel.answers import monitor_answers as answers
from appliance.channel.answers.monitor_answers import Replaced, Switched, findings_of
from appliance.specifications import in_force
from appliance.specifications.allocation import Allocation
from appliance.specifications.change_records import ChangeRecords, off_in
from appliance.specifications.givens import Givens, parse, split
from appliance.specifications.in_force import Coming, Consent, InForce, Order, Return, unknown_monitors
from appliance.specifications.judgement import Judge, beside_broken, broken_files, in_shadow
from appliance.specifications.live_topics import Published
from appliance.specifications.monitor_values import MonitorValues
from appliance.specifications.records import MonitorRecords
from appliance.specifications.rollout import Parts, Relays, Rollout
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    MonitorsChangedError,
    Sources,
    SpecificationFolder,
    SpecificationsRefusedError,
)
from appliance.specifications.specification_revisions import (
    NOTHING,
    UNCONFIRMED_CHANGE,
    Check,
    CheckBeside,
    kept_in,
    sources_of,
    specifications_at_start,
    text_of,
    text_with_warnings,
)
from appliance.specifications.switches import SHADOW, SWITCHES, Switch, Switches, word_of
from appliance.store.ends import EndKind, EndTable
from appliance.store.revisions import Revisions, reloaded_by
from appliance.store.state_file import MonitorRevisionRow, StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail
from rosmop.form.switch_words import Word, file_switch

_log = structlog.get_logger()
_NO_FOLDER = (
    "no folder of specifications is configured, so there is nothing to reload, and nothing was changed: start with"
    " --monitors DIR (monitors: DIR in appliance.yaml), or load files: rosrv monitor load FILE"
)
_STOPS = "monitor stops"
_ACTS = "monitor acts"
_GIVEN = "monitor given"
_RETURNS = "monitor returns"
_SINCE = "monitor orders since"
_REFUSED = "monitor folder refused"
ALLOCATION = "relays"
TIMED = EndKind("timed switch")
_LONGEST = 30 * 86_400.0  # seconds of a timed switch
_ALL = Consent(force=True, hold=True)
"""The consent of a rollback, which must never fail."""
_Check = Callable[[Sources], Awaitable[CheckedSpecifications]]
_Limit = tuple[EndKind, str, float]


class UnknownMonitorError(Exception):
    """A monitor, file or revision does not exist."""


class DryRunUnderWayError(Exception):
    """A client may have only one dry run at a time."""


class SpecificationManager(Revisions[MonitorRevisionRow]):
    """The specifications in force, the orders of operators about them, and what the relays report about monitors.

    Orders are carried out one at a time. They raise `SpecificationsRefusedError`, `UnknownMonitorError`, and
    `StoreError`, which has changed nothing.
    """

    refusal = SpecificationsRefusedError
    outdated = MonitorsChangedError
    unconfirmed = UNCONFIRMED_CHANGE

    def __init__(
        self,
        folder: Path | None,
        enable: str,
        store: StateStore,
        ends: EndTable,
        trail: AuditTrail,
        *,
        on_fault: Literal["drop", "pass"],
        slices: int,
        allocation: Allocation,
        relays: Relays,
        published: Callable[[], None],
        told: Collection[Callable[[messages.MonitorEvent], None]],
        site_keys: Sequence[str],
        check: CheckBeside,
        check_at_start: Check,
        try_out: CheckBeside,
        parts: Parts,
        live: Callable[[], Published],
    ) -> None:
        """`check` is for an order, `check_at_start` for a start, and `try_out` for a dry run.

        `live()` returns the topics published now; `published()` is called when monitors may publish other topics. With
        `site_keys`, everything in force is signed.
        """
        super().__init__(store, ends, store.monitor_revisions, store.save_monitor_revision, NOTHING)
        self.now = InForce(switches=Switches(enable))
        self._folder = SpecificationFolder(folder)
        self.site_keys = site_keys
        self.rollout = Rollout(allocation, trail, on_fault, relays, slices=slices, parts=parts)
        self._check, self._check_at_start, self._try_out = check, check_at_start, try_out
        self.judge = Judge(live, held=lambda: self.rollout.held, moved=self.rollout.moved_files)
        self._change_records = ChangeRecords(trail)
        self.records = MonitorRecords(
            trail,
            lambda topic, data: self.checked.fields(topic, data),  # noqa: PLW0108 - of whatever is in force then
            [*told],
            lambda stops: store.save_setting(_STOPS, stops),
        )
        self.values = MonitorValues(relays.send, self.rollout.relay_of, lambda: self.revision, trail)
        self._published = published
        self._ticking: asyncio.TimerHandle | None = None
        self._returning: asyncio.Task[None] | None = None
        self._attempting: set[str] = set()  # the clients with a dry run under way

    async def start(self, *, restarted: bool, taken_over: bool = False) -> None:
        """Bring specifications into force at the start of control.

        After a crash of control, or when it has `taken_over` from another appliance, they are those that were in
        force. At the start of the appliance, they are the folder's, unless an operator's own revision was in force.
        """
        settings = self.store.settings()
        self.records.start(settings.get(_STOPS, "[]"))
        last = self.in_force if self.find_last(restarted=restarted or taken_over) else None
        unconfirmed = self.ends.names(self.unconfirmed)
        self.now = InForce(
            self.revision,
            switches=self.switches.saying(json.loads(settings.get(SWITCHES, "{}"))),
            givens=Givens(json.loads(settings.get(_GIVEN, "{}"))),
            acts=int(settings.get(_ACTS, "0")),
            returns=msgspec.json.decode(settings.get(_RETURNS, "{}"), type=dict[str, Return]),
            back_to=int(unconfirmed[0]) if unconfirmed else None,
            since=frozenset(json.loads(settings.get(_SINCE, "[]"))),
            folder_refused=settings.get(_REFUSED, ""),
        )
        sources, checked, refused = await specifications_at_start(
            last,
            self._folder,
            self._check_at_start,
            self.site_keys,
            named=() if restarted else self.switches.named,
            kept=self.in_force if self.revision else None,
        )
        before, row = self.now, self.in_force
        coming = in_force.clear(replace(before, sources=sources, checked=checked))
        if last is None:  # the folder was read
            why = refused[0] if refused else ""
            coming = coming._replace(now=replace(coming.now, folder_refused=why))
        fresh = last is None and sources_of(row) != sources
        if fresh:
            coming = coming._replace(now=replace(coming.now, number=self.revision + 1))
            row = self._row(coming.now, DISK, "read at start")
        elif self.revision:  # a start may have looked for warnings that an earlier version did not store
            row = row._replace(sources=text_with_warnings(sources, checked))
        self._write(coming.now, row)
        earlier, self.now, self.in_force = sources_of(self.in_force), coming.now, row
        self._record_cleared(before, coming)
        if fresh:
            self._record_loaded(earlier, DISK)
        await self.rollout.start(self.now, restarted=restarted, kept=settings.get(ALLOCATION, ""))
        self._record_start(refused)
        for name in self.now.returns.keys() - set(self.ends.names(TIMED)):
            self.ends.set(TIMED, name, 0.0)
        self.ends.when_due(TIMED, self._switches_due)

    def _record_start(self, refused: Sequence[str]) -> None:
        checked = self.checked
        if refused:
            self._change_records.folder_refused(self.revision, refused)
        for name, error in checked.unbuilt.items():
            self._change_records.unbuilt(name, checked.monitors[name], error)
        for file, error in checked.left_out.items():
            self._change_records.left_out(file, error)
        unknown = sorted(self.switches.named - checked.monitors.keys())
        if unknown:  # the monitors were removed while the robot ran
            _log.warning("--enable names monitors that are not loaded", monitors=unknown)

    # --- queries ---

    @property
    def differs_from_folder(self) -> bool:
        return self.folder is not None and not self._is_folder(self.sources)

    def _is_folder(self, sources: Sources) -> bool:
        found = self._folder.looked_at() if self.folder is not None else None
        found = found and found.with_topics(sources.topics)
        return found is not None and (
            found == sources or found.without_switches() == sources.without_switches()
        )

    @property
    def folder(self) -> Path | None:
        return self._folder.path

    @property
    def tag(self) -> str:
        return self.now.tag

    @property
    def sources(self) -> Sources:
        return self.now.sources

    @property
    def checked(self) -> CheckedSpecifications:
        return self.now.checked

    @property
    def switches(self) -> Switches:
        return self.now.switches

    @property
    def givens(self) -> Givens:
        return self.now.givens

    @property
    def off(self) -> dict[str, str]:
        return off_in(self.now)

    def names(self) -> list[str]:
        return list(self.checked.monitors)

    def lasting(self, name: str) -> Word:
        """Return the switch that a monitor's file gives it, without a switch that ends automatically."""
        found = self.now.returns.get(name)
        return word_of(self.switches.states[name] if found is None else found.back)

    def until(self, name: str, *, of: Switch = False) -> float | None:
        """Return the end of a monitor's timed switch `of`, in seconds since the epoch, or None."""
        found = self.now.returns.get(name)
        return self.ends.date(TIMED, name) if found is not None and found.of == of else None

    def afresh(self, name: str) -> Word | None:
        """Return how a monitor would begin with a new state directory; None if its file is not in the folder."""
        sources = self._folder.looked_at()
        text = sources.files.get(self.checked.monitors[name]) if sources is not None else None
        if text is None:
            return None
        word = file_switch(text)
        return word or word_of(replace(self.switches, said={}).own(name))

    def statement(self, relay: int) -> messages.SpecificationsStated:
        return self.rollout.statement(relay)

    def file_of(self, name: str) -> str:
        """Return the file of `name`, which is a monitor or a file."""
        if name in self.sources.files:
            return name
        if name not in self.checked.monitors:
            raise UnknownMonitorError(self._unknown([name]))
        return self.checked.monitors[name]

    async def revisions(self, _request: admin.MonitorRevisions) -> answers.MonitorRevisionList:
        rows = [self.describe(row) for row in await self.rows()]
        return answers.MonitorRevisionList(msgspec.convert(rows, list[answers.MonitorRevision]))

    async def texts(self, request: admin.MonitorRevisionWanted) -> answers.RevisionTexts:
        row = await self.find(request.revision)
        if row is None:
            raise UnknownMonitorError(
                f"there is no revision {request.revision} of the specifications: rosrv monitor revisions lists all"
            )
        texts = msgspec.structs.asdict(sources_of(row))
        return msgspec.convert(self.describe(row) | texts, answers.RevisionTexts)

    async def show_values(self, request: admin.MonitorValuesWanted, who: str) -> answers.MonitorReadout:
        """Return the variables of a monitor. Raises `UnknownMonitorError`."""
        self._all_known([request.name])
        return await self.values.of(request.name, who)

    # --- orders ---

    async def load(self, request: admin.MonitorLoad, who: str, *, enable: bool = False) -> Replaced:
        """Load specifications.

        With `enable`, monitors are enabled even if the setting `enable` would disable them. With `confirm_within`, the
        change is rolled back after that many seconds unless confirmed.
        """
        async with self.changing(request.expected):
            order = self._loading(request, who, enable=enable)
            asks = request.shadow or request.given or request.files.keys() & broken_files(self.now).keys()
            if self.in_force.who != DISK and order.sources == self.sources and not asks:
                return self.replacement(self.revision, loaded=order.loaded)  # same texts: no new revision
            return await self._change(order, self._beside(self._check, order.loaded))

    async def attempt(self, asked: admin.MonitorTry, who: str) -> Replaced:
        request = self._as_load(asked.order)
        if who in self._attempting:
            raise DryRunUnderWayError(
                "your previous dry run is still running: wait for its answer, then try again"
            )
        if request.expected not in (None, self.tag):
            raise MonitorsChangedError(request.expected or "", self.tag)
        before, order = self.now, self._loading(request, who)
        self._attempting.add(who)
        try:
            check = self._beside(self._try_out, order.loaded)
            coming, warnings = await self._judge(before, order, check)
        finally:
            self._attempting.discard(who)
        added, changed, removed = order.sources.difference(before.sources)
        checked = coming.now.checked
        return Replaced(
            loaded=False, revision=before.number, tag=before.tag, added=added, changed=changed, removed=removed,
            warnings=findings_of([*checked.warnings, *warnings]), monitors=[*checked.monitors],
        )  # fmt: skip

    def _loading(self, request: admin.MonitorLoad, who: str, *, enable: bool = False) -> Order:
        topics, constants = split(request.given)
        new, files = Sources(request.files, request.definitions, request.signatures, topics), [*request.files]
        return Order(
            self.sources.with_files(new), who, request.note or "loaded", request.confirm_within,
            Consent(request.force, request.hold), loaded=files, shadow=files if request.shadow else (),
            enable=files if enable else (), topics=topics, constants=constants,
        )  # fmt: skip

    def _beside(self, check: CheckBeside, loaded: Collection[str] = ()) -> _Check:
        return partial(beside_broken, self.now, check, self.site_keys, loaded=loaded)

    async def _strictly(self, sources: Sources) -> CheckedSpecifications:
        return await self._check(sources, self.site_keys, ())

    async def replace(self, request: admin.MonitorReplace, who: str) -> Replaced:
        return await self.load(self._as_load(request), who)

    def _as_load(self, request: admin.MonitorLoad | admin.MonitorReplace) -> admin.MonitorLoad:
        if isinstance(request, admin.MonitorLoad):
            return request
        file = self.file_of(request.name)
        return admin.MonitorLoad(
            {file: request.text},
            request.definitions,
            request.note,
            request.expected,
            request.confirm_within,
            {**request.signatures, file: request.signature},
            request.force,
            request.shadow,
            request.hold,
            {request.name: request.given} if request.given else {},
        )

    async def reload(self, request: admin.MonitorReload, who: str) -> Replaced:
        """Load the folder; files that are not in it stay in force, unless `prune` is set.

        The same texts make no new revision, unless one has an error.
        """
        async with self.changing(request.expected):
            if self._folder.path is None:
                raise SpecificationsRefusedError([_NO_FOLDER])
            sources = await asyncio.to_thread(self._folder.read)
            sources = sources.with_topics(self.sources.topics)
            kept = [] if request.prune else sorted(self.sources.files.keys() - sources.files.keys())
            if kept:
                sources = self.sources.with_files(sources)
            keeper = who if kept else DISK  # with `DISK`, the next start would read only the folder
            same = sources == self.sources and (self.in_force.who == DISK) == (keeper == DISK)
            if same and not broken_files(self.now):
                return self.replacement(self.revision, kept=kept)
            added, changed, _removed = sources.difference(self.sources)
            shadow = [*added, *changed] if request.shadow else []
            consent = Consent(request.force, request.hold)
            order = Order(
                sources, who, reloaded_by(who), request.confirm_within, consent,
                author=keeper, kept=kept, shadow=shadow,
            )  # fmt: skip
            return await self._change(order, self._strictly)

    async def take_bundle(self, sources: Sources, who: str, note: str, expected: str) -> Replaced:
        """Bring exactly these sources into force."""
        async with self.changing(expected):
            sources = sources.with_topics(self.sources.topics)
            if self.in_force.who != DISK and sources == self.sources:
                return self.replacement(self.revision)  # same texts: no new revision
            return await self._change(Order(sources, who, note, consent=Consent(hold=True)), self._strictly)

    async def held_by_bundle(self, sources: Sources) -> list[str]:
        sources = sources.with_topics(self.sources.topics)
        if sources == self.sources:
            return []
        coming = replace(self.now, sources=sources, checked=await self._strictly(sources))
        return self.judge.holds(self.now, coming, in_shadow(coming), hold=False).conflicts

    async def remove(self, request: admin.MonitorRemove, who: str, *, settled: bool = False) -> Replaced:
        """Remove files, or the files of monitors, if no other monitor is in them or uses their variables.

        With `settled`, nothing waits for a confirmation afterwards.
        """
        async with self.changing(request.expected):
            names, owners = request.names, self.checked.monitors
            known = set(self.sources.files) | set(owners)
            unknown = [name for name in names if name not in known]
            if unknown:
                raise UnknownMonitorError(self._unknown(unknown))
            files = {owners.get(name, name) for name in names}
            left = sorted(
                monitor
                for monitor, file in owners.items()
                if file in files and not {monitor, file} & set(names)
            )
            if left:
                text = f"this would also remove {', '.join(left)} from the same file: name the file, or load it without"
                raise SpecificationsRefusedError([text])
            sources, note = self.sources.without(files), f"removed {', '.join(sorted(files))}"
            keeper, within = who, request.confirm_within
            if within is None and self._is_folder(sources):
                keeper = DISK  # the baseline again, so the next start reads the folder
            order = Order(sources, who, note, within, author=keeper, settled=settled)
            return await self._change(order, self._beside(self._check))

    async def roll_back(self, request: admin.MonitorRollback, who: str) -> Replaced:
        """Bring a revision into force again: None is the previous revision, 0 no specifications.

        The rollback of an unconfirmed change must succeed, so a file with an error does nothing, as after a start. It
        also brings back switches and constants, except for what operators ordered since.
        """
        async with self.changing(request.expected):
            row = NOTHING if request.revision == 0 else await self.require(request.revision)
            note, last = f"rolled back to revision {row.revision}", kept_in(row)
            check: _Check = (
                (lambda sources: self._check_at_start(sources, self.site_keys, last.warnings))
                if who == UNCONFIRMED
                else self._strictly
            )
            order = Order(
                sources_of(row), who, note, consent=_ALL, switches=last.switches, given=last.given,
                undoes=who == UNCONFIRMED, settled=self.settles(row.revision),
            )  # fmt: skip
            return await self._change(order, check)

    async def confirm(self, request: admin.MonitorConfirm, who: str) -> answers.MonitorsConfirmed:
        async with self.changing(request.expected):
            promoted = self.now.promoted
            waited = self.confirm_by is not None or bool(promoted)
            if waited:
                await self._bring(in_force.confirm(self.now), tell=())
                self._change_records.record_confirmation(self.revision, promoted, who)
            return answers.MonitorsConfirmed(waited, self.revision, self.tag)

    async def switch(self, request: admin.MonitorSwitch, who: str) -> Switched:
        """Switch monitors; return those that changed. A monitor is not enabled if it is in shadow mode, or shares
        variables with such a monitor.
        """
        async with self.changing(request.expected):
            self._all_known(request.names)
            seconds = request.for_seconds
            if seconds is not None and (request.enabled or not 0 < seconds <= _LONGEST):
                text = f"a monitor may be disabled for up to {_LONGEST / 86_400:g} days; it is not enabled for a time"
                raise SpecificationsRefusedError([text])
            shadowed = [name for name in request.names if request.enabled and self.switches.in_shadow(name)]
            if shadowed:
                text = f"{', '.join(shadowed)} is in shadow mode: rosrv monitor enforce brings it into force"
                raise SpecificationsRefusedError([text])
            names = await self._switch(request.names, request.enabled, who, seconds)
            until = self.until(names[0]) if names else None
            return Switched(names, self.revision, self.tag, until=until)

    async def shadow(self, request: admin.MonitorShadow, who: str) -> Switched:
        """Return the monitors that changed. With `confirm_within`, they return to shadow mode unless confirmed."""
        async with self.changing(request.expected):
            self.judge_shadow(request)
            names = await self._switch(
                request.names, SHADOW if request.shadow else True, who, request.confirm_within
            )
            began, confirm_by = self.rollout.began(names), self.until(request.names[0], of=True)
            return Switched(names, self.revision, self.tag, began, confirm_by=confirm_by)

    def judge_shadow(self, request: admin.MonitorShadow) -> list[str]:
        self._all_known(request.names)
        disabled = [name for name in request.names if self.switches.states[name] is False]
        if disabled and not request.shadow:
            text = f"{', '.join(disabled)} is disabled, not in shadow mode: rosrv monitor enable"
            raise SpecificationsRefusedError([text])
        warnings = []
        if not request.shadow:
            others = set(self.switches.shadowed_monitors()) - set(request.names)
            warnings = self.judge.judge(
                self.now, self.now, others, Consent(request.force), promoted=request.names
            )
        self._check_limit(request)
        return warnings

    def _check_limit(self, request: admin.MonitorShadow) -> None:
        """Raise `SpecificationsRefusedError` if a monitor would have no shadow mode to return to."""
        if request.confirm_within is None:
            return
        if request.shadow:
            raise SpecificationsRefusedError(["shadow mode has no time limit: leave out confirm_within"])
        confirmed = [
            name
            for name in request.names
            if self.switches.is_enabled(name) and self.until(name, of=True) is None
        ]
        if confirmed:
            text = f"{', '.join(confirmed)} is in force already, so it cannot wait for a confirmation"
            raise SpecificationsRefusedError([text])

    def _switches_due(self, _names: Collection[str]) -> None:
        if self._returning is None or self._returning.done():
            self._returning = asyncio.get_running_loop().create_task(self._return_switches())

    async def _return_switches(self) -> None:
        """Switch back what is due. Monitors that cannot, as they now share variables with others, are tried again."""
        async with self.changing(None):
            due = {name: one for name, one in self.now.returns.items() if self.ends.is_over(TIMED, name)}
            for back in dict.fromkeys(due.values()):
                names = [name for name, one in due.items() if one == back]
                who = UNCONFIRMED if back.of is True else "its disabled period is over"
                try:
                    await self._switch(names, back.back, who, due=True)
                except SpecificationsRefusedError as error:
                    _log.error("a monitor cannot be switched back yet", monitors=names, error=str(error))
            try:
                await self.store.until_settled()
            except StoreError as error:
                _log.error("switches that ended are not saved", monitors=[*due], reason=str(error))

    async def _switch(
        self,
        names: Sequence[str],
        to: Switch,
        who: str,
        seconds: float | None = None,
        *,
        due: bool = False,
    ) -> list[str]:
        now, switches = self.now, self.switches
        changed = [
            name
            for name in dict.fromkeys(names)
            if switches.states[name] != to
            or seconds is not None
            or (to is False and name in now.returns)
            or (to is not True and name not in switches.said)  # it is off by the setting, and now by an order
        ]
        if not changed:
            return changed
        new = in_force.switch(now, changed, to, timed=seconds is not None, due=due)
        told = [(name, messages.MonitorSwitched(name, to is True)) for name in changed]
        shadow = to == SHADOW or any(map(switches.in_shadow, changed))
        limits = [] if seconds is None else [(TIMED, name, seconds) for name in changed]
        await self._bring(new, limits=limits, tell=None if shadow else told, due=due)
        for name in changed:
            self._say_switched(name, to, who, earlier=now.states[name])
        await self.rollout.carried_out()
        return changed

    async def resume(self, request: admin.MonitorResume, who: str) -> Switched:
        """Release the topics that monitors hold, and let them await no node; return the monitors that held any.

        A relay that is not running is refused, because the next process will hold the topics again.
        """
        async with self.changing(request.expected):
            self._all_known(request.names)
            rows = self.rollout.rows
            held = [
                name for name in dict.fromkeys(request.names)
                if name in self.rollout.held or (name in rows and rows[name].awaits)
            ]  # fmt: skip
            if held:
                await self._bring(replace(self.now, acts=self.now.acts + 1), tell=())
            away = []
            for name in held:
                if not self.rollout.tell(name, messages.MonitorResumed(name)):
                    away.append(name)
                    continue
                self.rollout.resumed(name)
                self._change_records.record_resume(name, who)
            if away:
                text = f"{', '.join(away)} not resumed: the relay process is not running; resume when it runs again"
                raise SpecificationsRefusedError([text])
            await self.rollout.carried_out()
            return Switched(held, self.revision, self.tag)

    async def give(self, request: admin.MonitorGive, who: str) -> answers.GivenSet:
        async with self.changing(request.expected):
            name = request.name
            self._all_known([name])
            present = {state.name: state.value for state in self.givens.states(self.checked, name)}
            new = parse(self.checked.givens.get(name, ()), name, request.values)
            changed = [one for one, value in new.items() if value != present[one]]
            if changed:
                coming = in_force.give(self.now, name, new)
                values = coming.givens.in_force(coming.checked)[name]
                await self._bring(coming, tell=[(name, messages.MonitorGiven(name, values))])
                self._record_given(name, {one: present[one] for one in changed}, who)
                await self.rollout.carried_out()
            given = self.givens.states(self.checked, name)
            return answers.GivenSet(name, changed, given, self.revision, self.tag)

    # --- the next value ---

    async def _change(self, order: Order, check: _Check) -> Replaced:
        """Make the next revision. Raises as `_bring` does."""
        try:
            return await self._changed(order, check)
        finally:
            self._published()

    async def _changed(self, order: Order, check: _Check) -> Replaced:
        before, due = self.now, order.who == UNCONFIRMED
        try:
            coming, warnings = await self._judge(before, order, check)
            row = self._row(coming.now, order.author or order.who, order.note)
            limits: list[_Limit] = []
            if order.within is not None:
                limits.append((self.unconfirmed, str(coming.now.back_to), order.within))
            moved = await self._bring(coming.now, row, limits=limits, due=due)
        except SpecificationsRefusedError as error:
            others = ", ".join(order.kept)
            hint = [f"not of the folder, and kept: {others} (prune removes them)"] if others else []
            findings = error.findings + hint
            self._change_records.record_refusal(self.revision, error.findings[0], findings, order.who)
            raise SpecificationsRefusedError(findings) from error
        except StoreError as error:
            self._change_records.record_refusal(self.revision, "it cannot be stored", [str(error)], order.who)
            raise
        self._record_cleared(before, coming)
        self._record_loaded(before.sources, order.who, warnings, self.rollout.began(self.names()))
        for name, to in coming.put.items():
            how = ", as before the change" if order.undoes else ", as it was loaded"
            self._say_switched(name, to, order.who, how, earlier=before.states.get(name))
        for name, values in coming.given.items():
            own = {state.name: state.default for state in self.givens.states(self.checked, name)}
            own |= {state.name: state.value for state in before.givens.states(before.checked, name)}
            self._record_given(name, {value: own[value] for value in values}, order.who)
        if due:
            await self.store.until_settled()
        await self.rollout.all_taken()
        began = self.rollout.began(self.names())  # also on relays that took them only now
        files = self.sources.difference(before.sources)
        done = self.replacement(before.number, files, moved, began, order.kept, loaded=order.loaded)
        done.warnings.extend(findings_of(warnings))
        return done

    async def _judge(self, before: InForce, order: Order, check: _Check) -> tuple[Coming, list[str]]:
        checked = await check(order.sources)
        coming = in_force.load(before, order, checked, signed=bool(self.site_keys))
        warnings = self.judge.judge(before, coming.now, in_shadow(coming.now), order.consent)
        places = {name: owner.position for name, owner in checked.states.items()}
        warnings += [f"{places[one.monitor]}: warning: {one.text}" for one in coming.dropped]
        return coming, warnings

    async def _bring(
        self,
        new: InForce,
        row: MonitorRevisionRow | None = None,
        *,
        limits: Sequence[_Limit] = (),
        tell: Sequence[tuple[str, messages.Message]] | None = None,
        due: bool = False,
    ) -> list[str]:
        """Bring the next value into force on all relays, or on none; return the monitors that began again elsewhere.

        `limits` begin with it. `tell` are messages for the relays of monitors; without them, the value is rolled out. A
        return that is `due` does not wait for the store, so the caller does. Raises `StoreError` and
        `SpecificationsRefusedError`; then the present value is still in force.
        """
        if tell is not None:
            take_effect()  # otherwise the rollout decides when
        if not due:
            try:
                self.store.database.require_room()
            except StoreError as error:
                raise StoreError(self._stays(str(error))) from error
        row = row or self.in_force
        moved = await self.rollout.take(new) if tell is None else []
        if problem := await self._store(new, row, limits, wait=not due):
            if tell is None:
                await self.rollout.take_back(self.now)
            raise StoreError(self._stays(problem))
        self.now, self.in_force = new, row
        self.rollout.adopt(new)
        for name, message in tell or ():
            self.rollout.tell(name, message)
        return moved

    def replacement(
        self,
        before: int,
        files: tuple[list[str], list[str], list[str]] = ([], [], []),
        moved: Sequence[str] = (),
        began: Sequence[str] = (),
        kept: Collection[str] = (),
        *,
        loaded: Collection[str] = (),
    ) -> Replaced:
        checked, (added, changed, removed) = self.checked, files
        touched = {*loaded, *added, *changed}
        states = {name: self.now.states[name] for name, file in checked.monitors.items() if file in touched}
        return Replaced(
            loaded=True, revision=self.revision, tag=self.tag, replaced=before,
            added=added, changed=changed, removed=removed, warnings=findings_of(checked.warnings),
            monitors=[*checked.monitors], moved=[*moved], began=[*began], kept=[*kept], confirm_by=self.confirm_by,
            disabled=[name for name, state in states.items() if state is False],
            shadow=[name for name, state in states.items() if state == SHADOW],
            held={name: why for name, why in self.rollout.why_held.items() if name in states},
        )  # fmt: skip

    async def _go_back(self, revision: int) -> None:
        await self.roll_back(admin.MonitorRollback(revision), UNCONFIRMED)

    # --- storing ---

    async def _store(
        self, new: InForce, row: MonitorRevisionRow, limits: Sequence[_Limit], *, wait: bool
    ) -> str:
        """Store the next value; return why it is not stored. The store has the present one again in that case."""
        undo, problem = [self.ends.undo(kind) for kind in (self.unconfirmed, TIMED)], ""
        try:
            self._write(new, row, limits)
            if wait and (problem := await self.store.database.unwritten()):
                problem += "; check the disk, and try again"
        except StoreError as error:  # the appliance is stopping
            problem = str(error)
        if problem:
            self._cancel_return()  # its limit may be that of the next value
            with contextlib.suppress(StoreError), self.store.database.together():
                for restore in undo:
                    restore()
                self._write_words(self.now)
                if row.revision != self.revision:
                    self.store.forget_monitor_revision(row.revision)
                    if self.revision:
                        self.store.save_monitor_revision(self.in_force)
        return problem

    def _write(self, new: InForce, row: MonitorRevisionRow, limits: Sequence[_Limit] = ()) -> None:
        """Store a value and its revision, with the last switches and values of the one before it."""
        if new.back_to is None or any(kind is self.unconfirmed for kind, *_ in limits):
            self._cancel_return()
        with self.store.database.together():  # control may die during the change
            if row.revision != self.revision and self.revision:
                given = {name: dict(values) for name, values in self.givens.said.items()}
                after = {
                    name: end.back for name, end in self.now.returns.items()
                }  # else for good, after a rollback
                ended = msgspec.structs.replace(
                    kept_in(self.in_force), switches=dict(self.switches.said) | after, given=given
                )
                self.store.save_monitor_revision(self.in_force._replace(sources=text_of(ended)))
            if row != self.in_force:
                self.store.save_monitor_revision(row)
            self._write_words(new)
            for limit in limits:
                self.ends.set(*limit)

    def _write_words(self, now: InForce) -> None:
        for kind, kept in ((self.unconfirmed, {str(now.back_to)}), (TIMED, now.returns)):
            self.ends.forget(kind, *(name for name in self.ends.names(kind) if name not in kept))
        self.store.save_setting(_ACTS, str(now.acts))
        self.store.save_setting(SWITCHES, json.dumps(dict(now.switches.said)))
        self.store.save_setting(_GIVEN, json.dumps(dict(now.givens.said)))
        self.store.save_setting(_RETURNS, msgspec.json.encode(now.returns).decode())
        self.store.save_setting(_SINCE, json.dumps(sorted(now.since)))
        self.store.save_setting(_REFUSED, now.folder_refused)

    def _stays(self, problem: str) -> str:
        waits = self.confirm_by is not None or self.now.promoted
        how = " unconfirmed" if waits else ""
        return f"revision {self.revision} of the specifications stays in force{how}: {problem}"

    def _row(self, new: InForce, who: str, note: str) -> MonitorRevisionRow:
        text = text_with_warnings(new.sources, new.checked)
        return MonitorRevisionRow(new.number, text, clock.wall(), who, note)

    def describe(self, row: MonitorRevisionRow) -> dict[str, Any]:
        return super().describe(row) | {"names": list(sources_of(row).files)}

    # --- records ---

    def _record_cleared(self, before: InForce, coming: Coming) -> None:
        for name in coming.drawn_in:
            why = ": it shares variables with one that is"
            self._say_switched(name, SHADOW, self.in_force.who, why, earlier=before.states.get(name))
        for dropped in coming.dropped:
            self._change_records.record_drop(dropped, self.in_force.who)

    def _record_loaded(
        self, earlier: Sources, who: str, warnings: Sequence[str] = (), began: Sequence[str] = ()
    ) -> None:
        changed = self.sources.difference(earlier)
        row = self.in_force._replace(note=f"{self.in_force.note}{self.unless_confirmed}")
        self._change_records.record_load(
            row, earlier, self.now, who, began=began, changed=changed, warnings=warnings
        )

    def _say_switched(
        self, name: str, to: Switch, who: str, why: str = "", *, earlier: Switch | None
    ) -> None:
        until = self.until(name) or self.until(name, of=True)
        self._change_records.record_switch(name, to, who, why, earlier=earlier, until=until)

    def _record_given(self, name: str, before: Mapping[str, messages.GivenValue], who: str) -> None:
        states = {state.name: state for state in self.givens.states(self.checked, name)}
        self._change_records.record_values(name, states, before, who)

    # --- messages of relays ---

    def received(self, message: messages.Message, relay: int = 0) -> None:
        if isinstance(message, messages.MonitorsReported):
            self.records.reported(message.events, message.lost, message.ahead)
            if self._ticking is None:
                self._tick()
        elif isinstance(message, messages.ValuesSeen):
            self.values.received(message, relay)
        else:
            self.rollout.received(message, relay)

    def relay_lost(self, relay: int) -> None:
        self.rollout.lost(relay)
        self.values.relay_lost(relay)

    def _tick(self) -> None:
        try:
            self.records.tick()
        finally:
            going_on = self.records.some
            self._ticking = asyncio.get_running_loop().call_later(1.0, self._tick) if going_on else None

    # --- inside ---

    def _unknown(self, names: list[str]) -> str:
        return unknown_monitors(names, self.checked)

    def _all_known(self, names: list[str]) -> None:
        unknown = [name for name in names if name not in self.checked.monitors]
        if unknown:
            raise UnknownMonitorError(self._unknown(unknown))
