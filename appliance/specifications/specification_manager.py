"""The specifications in force: load, switch, roll back, and answer operators.

An immutable value holds all that is in force (`in_force.py`). A change replaces it once all relays have its successor.

1. The appliance never writes to the folder of specifications. Changes are revisions in the store; revisions and
   switches survive a restart.
2. If a text has errors, or a relay refuses its compiled form, nothing changes.
3. A load or switch of other monitors never takes an existing monitor out of force.
4. Files that are not in the folder stay in force unless a reload prunes, so a missing file ends no protection.
5. Each revision is stored with its last switches, so a rollback restores its monitors as they were.
6. Each change gets a new tag, which never repeats; a change that expects another tag is refused.
"""

import asyncio
import json
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import structlog

from appliance.base import clock
from appliance.base.actors import DISK, UNCONFIRMED
from appliance.base.withdrawal import take_effect
from appliance.channel import admin, messages
from appliance.channel.answers import monitor_answers as answers
from appliance.channel.answers.monitor_answers import Replacement, Switched
from appliance.specifications import in_force
from appliance.specifications.allocation import Allocation
from appliance.specifications.change_records import WORDS, ChangeRecords
from appliance.specifications.givens import Givens, parsed, split
from appliance.specifications.in_force import InForce, Wanted, unknown_monitors
from appliance.specifications.live_topics import Published, TopicFindings, judge_holds, judge_topics
from appliance.specifications.monitor_values import MonitorValues
from appliance.specifications.records import MonitorRecords
from appliance.specifications.rollout import Parts, Relays, Rollout
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
    SpecificationFolder,
    SpecificationsRefusedError,
)
from appliance.specifications.specification_revisions import (
    NOTHING,
    Check,
    CheckBeside,
    StoredSpecifications,
    kept_in,
    sources_of,
    specifications_at_start,
    text_of,
    text_with_warnings,
)
from appliance.specifications.switches import SHADOW, SWITCHES, Switch, Switches
from appliance.specifications.timed_switches import LONGEST, TimedSwitches
from appliance.store.ends import EndKind, EndTable
from appliance.store.revisions import Revisions, reloaded_by
from appliance.store.state_file import MonitorRevisionRow, StateStore
from appliance.telemetry.audit_trail import AuditTrail

_log = structlog.get_logger()
_ACTS = "monitor acts"
_STOPS = "monitor stops"
_GIVEN = "monitor given"
ALLOCATION = "relays"
_NO_FOLDER = (
    "no folder of specifications is configured, so there is nothing to reload, and nothing was changed: start with"
    " --monitors DIR (monitors: DIR in appliance.yaml), or load files: rosrv monitor load FILE"
)


_NO_FILES: tuple[list[str], list[str], list[str]] = ([], [], [])


class UnknownMonitorError(Exception):
    """A monitor, file or revision does not exist."""


class DryRunUnderWayError(Exception):
    """A client may have only one dry run at a time."""


class MonitorsChangedError(Exception):
    """The monitors changed after a change was prepared; `tag` is the present one."""

    def __init__(self, expected: str, tag: str) -> None:
        super().__init__(
            f"the monitors were loaded, switched or resumed in the meantime (they are at {tag}, not at {expected}):"
            " list them first"
        )
        self.tag = tag


class _Consent(NamedTuple):
    """The operator's consent to cut topics whose publishers have another type, and to hold topics with traffic."""

    force: bool = False
    hold: bool = False


_NO_CONSENT = _Consent()
_ALL = _Consent(force=True, hold=True)
"""The consent of a rollback, which must never fail."""


@dataclass(frozen=True, slots=True)
class _Order:
    """The author of a change, and its terms.

    `within` is the time in which it must be confirmed. `author` is the author of the revision, unless it is `who`.
    `kept` are files that are not in the folder, `loaded` those that the operator named.
    """

    who: str
    note: str
    within: float | None = None
    consent: _Consent = _NO_CONSENT
    author: str = ""
    kept: Sequence[str] = ()
    loaded: Collection[str] = ()
    warnings: Sequence[str] = ()


class _Checks(NamedTuple):
    """The checks of an order, of a start, and of a dry run."""

    order: CheckBeside
    at_start: Check
    dry_run: CheckBeside


class SpecificationManager(Revisions[MonitorRevisionRow]):
    """The specifications in force.

    Changes are made one at a time; they raise `SpecificationsRefusedError` and `UnknownMonitorError`. `published()`
    is called when monitors may publish other topics. With `site_keys`, everything in force is signed.
    """

    refusal = SpecificationsRefusedError
    outdated = MonitorsChangedError
    unconfirmed = EndKind("confirm monitors")

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

        `live()` returns the topics published now.
        """
        super().__init__(store, ends, store.monitor_revisions, store.save_monitor_revision, NOTHING)
        self._folder = SpecificationFolder(folder)
        self.site_keys = site_keys
        self._checks = _Checks(check, check_at_start, try_out)
        self._live = live
        self._change_records = ChangeRecords(trail)
        self.now = InForce(switches=Switches(enable))
        self.rollout = Rollout(allocation, trail, on_fault, relays, slices=slices, parts=parts)
        self._attempting: set[str] = set()  # clients with a dry run under way
        self.returns = TimedSwitches(store, ends, self._come_back)
        self.records = MonitorRecords(
            trail,
            lambda topic, data: self.checked.fields(topic, data),  # noqa: PLW0108 - of whatever is in force then
            [*told],
            lambda stops: store.save_setting(_STOPS, stops),
        )
        self.values = MonitorValues(self.rollout.tell, lambda: self.revision, trail)
        self._ticking: asyncio.TimerHandle | None = None
        self._published = published

    # --- start ---

    async def start(self, *, restarted: bool, taken_over: bool = False) -> None:
        """Bring specifications into force at the start of control.

        After a crash of control, or when it has `taken_over` from another appliance, they are those that were in
        force. At the start of the appliance, they are the folder's, unless an operator's own revision was in force.
        """
        settings = self.store.settings()
        said = InForce(
            switches=self.switches.saying(json.loads(settings.get(SWITCHES, "{}"))),
            givens=Givens(json.loads(settings.get(_GIVEN, "{}"))),
            acts=int(settings.get(_ACTS, "0")),
        )
        self.now = said
        self.records.start(settings.get(_STOPS, "[]"))
        last = self.in_force if self._find_last(restarted=restarted or taken_over) else None
        named = () if restarted else self.switches.named
        sources, checked, refused = await specifications_at_start(
            last,
            self._folder,
            self._checks.at_start,
            self.site_keys,
            named=named,
            kept=self.in_force if self.revision else None,
        )
        new = replace(said, number=self.revision, sources=sources, checked=checked)
        if last is not None or (self.revision and sources_of(self.in_force) == sources):
            self._enforce(new)
            self._keep_warnings()
        else:
            self._end_limit()
            if sources.files or self.revision:
                self._keep(said, replace(new, number=self.revision + 1), _Order(DISK, "read at start"))
            else:
                self._enforce(new)
        await self.rollout.start(self.now, restarted=restarted, kept=settings.get(ALLOCATION, ""))
        if refused:
            self._change_records.folder_refused(self.revision, refused)
        for name, error in checked.unbuilt.items():
            self._change_records.unbuilt(name, checked.monitors[name], error)
        for file, error in checked.left_out.items():
            self._change_records.left_out(file, error)
        self.returns.start(self.switches.states)
        unknown = sorted(self.switches.named - self.checked.monitors.keys())
        if unknown:  # the monitors were removed while the robot ran
            _log.warning("--enable names monitors that are not loaded", monitors=unknown)

    # --- queries ---

    @property
    def folder(self) -> Path | None:
        return self._folder.path

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
    def tag(self) -> str:
        return self.now.tag

    @property
    def differs_from_folder(self) -> bool:
        return self._folder.path is not None and not self._is_folder(self.sources)

    def names(self) -> list[str]:
        return list(self.checked.monitors)

    def file_of(self, name: str) -> str:
        """Return the file of `name`, which is a monitor or a file."""
        if name in self.sources.files:
            return name
        if name not in self.checked.monitors:
            raise UnknownMonitorError(self._unknown([name]))
        return self.checked.monitors[name]

    async def revisions(self, _request: admin.MonitorRevisions) -> answers.MonitorRevisionList:
        rows = [self._described(row) for row in await self._kept()]
        return answers.MonitorRevisionList(msgspec.convert(rows, list[answers.MonitorRevision]))

    async def texts(self, request: admin.MonitorRevisionWanted) -> answers.RevisionTexts:
        row = await self._find(request.revision)
        if row is None:
            raise UnknownMonitorError(
                f"there is no revision {request.revision} of the specifications: rosrv monitor revisions lists all"
            )
        texts = msgspec.structs.asdict(sources_of(row))
        return msgspec.convert(self._described(row) | texts, answers.RevisionTexts)

    def statement(self, relay: int) -> messages.SpecificationsStated:
        return self.rollout.statement(relay)

    # --- changing ---

    async def load(self, request: admin.MonitorLoad, who: str, *, enable: bool = False) -> Replacement:
        """Load specifications.

        With `enable`, monitors are enabled even if the setting `enable` would disable them. With `confirm_within`, the
        change is rolled back after that many seconds unless confirmed.
        """
        async with self._changing(request.expected):
            topics, constants = split(request.given)
            new = Sources(request.files, request.definitions, request.signatures, topics)
            sources = self.sources.with_files(new)
            asks = request.shadow or request.given or new.files.keys() & self._broken().keys()
            if self.in_force.who != DISK and sources == self.sources and not asks:
                return self._replaced(
                    self.revision, _NO_FILES, loaded=new.files
                )  # same texts: no new revision
            files = frozenset(new.files)
            shadow, enabled = files if request.shadow else (), files if enable else ()
            order = _Order(
                who, request.note or "loaded", request.confirm_within, _Consent(request.force, request.hold),
                loaded=files,
            )  # fmt: skip
            check = partial(self._beside_broken, self._checks.order, loaded=files)
            return await self._change(Wanted(sources, shadow, enabled, topics, constants), check, order)

    async def attempt(self, request: admin.MonitorTry, who: str) -> answers.Tried:
        if who in self._attempting:
            raise DryRunUnderWayError(
                "your previous dry run is still running: wait for its answer, then try again"
            )
        if request.expected not in (None, self.tag):
            raise MonitorsChangedError(request.expected or "", self.tag)
        self._attempting.add(who)
        try:
            present, revision, tag = self.sources, self.revision, self.tag
            topics, constants = split(request.given)
            new = Sources(request.files, request.definitions, request.signatures, topics)
            following = present.with_files(new)
            checked = await self._beside_broken(self._checks.dry_run, following, request.files)
            in_force.constants_of(
                Wanted(following, topics=topics, constants=constants), checked, signed=bool(self.site_keys)
            )
        finally:
            self._attempting.discard(who)
        coming = replace(self.now, sources=following, checked=checked)
        shadow = _in_shadow(coming, request.files if request.shadow else ())
        warnings = self._judged(coming, shadow, _Consent(request.force, request.hold))
        files = following.difference(present)
        return answers.Tried(revision, tag, *files, [*checked.warnings, *warnings], [*checked.monitors])

    async def replace(self, request: admin.MonitorReplace, who: str) -> Replacement:
        file = self.file_of(request.name)
        load = admin.MonitorLoad(
            {file: request.text},
            request.definitions,
            request.note,
            request.expected,
            request.confirm_within,
            {**request.signatures, file: request.signature},
            request.force,
            request.shadow,
            request.hold,
        )
        return await self.load(load, who)

    async def reload(self, request: admin.MonitorReload, who: str) -> Replacement:
        """Load the folder; files that are not in it stay in force, unless `prune` is set."""
        async with self._changing(request.expected):
            if self._folder.path is None:
                raise SpecificationsRefusedError([_NO_FOLDER])
            sources = await asyncio.to_thread(self._folder.read)
            sources = sources.with_topics(self.sources.topics)
            kept = [] if request.prune else sorted(self.sources.files.keys() - sources.files.keys())
            if kept:
                sources = self.sources.with_files(sources)
            keeper = who if kept else DISK  # with `DISK`, the next start would read only the folder
            added, changed, _removed = sources.difference(self.sources)
            shadow = frozenset([*added, *changed]) if request.shadow else frozenset()
            consent = _Consent(request.force, request.hold)
            order = _Order(who, reloaded_by(who), request.confirm_within, consent, author=keeper, kept=kept)
            return await self._change(Wanted(sources, shadow), self._strictly, order)

    async def take_bundle(self, sources: Sources, who: str, note: str) -> Replacement:
        """Bring exactly these sources into force."""
        async with self._changing(None):
            sources = sources.with_topics(self.sources.topics)
            if self.in_force.who != DISK and sources == self.sources:
                return self._replaced(self.revision, _NO_FILES)  # same texts: no new revision
            order = _Order(who, note, consent=_Consent(hold=True))
            return await self._change(Wanted(sources), self._strictly, order)

    async def held_by_bundle(self, sources: Sources) -> list[str]:
        sources = sources.with_topics(self.sources.topics)
        if sources == self.sources:
            return []
        coming = replace(self.now, sources=sources, checked=await self._strictly(sources))
        return self._held(coming, _in_shadow(coming), hold=False).conflicts

    async def remove(self, request: admin.MonitorRemove, who: str) -> Replacement:
        """Remove files, or the files of monitors, if no other monitor is in them or uses their variables."""
        async with self._changing(request.expected):
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
            check = partial(self._beside_broken, self._checks.order)
            return await self._change(Wanted(sources), check, _Order(who, note, within, author=keeper))

    async def roll_back(self, request: admin.MonitorRollback, who: str) -> Replacement:
        """Bring a revision into force again: None is the previous revision, 0 no specifications.

        The rollback of an unconfirmed change must succeed, so a file with an error does nothing, as after a start.
        """
        async with self._changing(request.expected):
            row = NOTHING if request.revision == 0 else await self._wanted(request.revision)
            note, last = f"rolled back to revision {row.revision}", kept_in(row)
            as_before = partial(self._as_at_start, known=last.warnings)
            check = as_before if who == UNCONFIRMED else self._strictly
            wanted = Wanted(sources_of(row), switches=last.switches, given=last.given)
            return await self._change(wanted, check, _Order(who, note, consent=_ALL))

    async def confirm(self, request: admin.MonitorConfirm, who: str) -> answers.MonitorsConfirmed:
        async with self._changing(request.expected):
            promoted = self.returns.unconfirmed()
            waited = self.confirm_by is not None or bool(promoted)
            if waited:
                self._end_limit()
                self.returns.end(promoted)
                self._change_records.confirmed(self.revision, promoted, who)
                await self.store.settled()
            return answers.MonitorsConfirmed(waited, self.revision, self.tag)

    async def switch(self, request: admin.MonitorSwitch, who: str) -> Switched:
        """Switch monitors; return those that changed. A monitor is not enabled if it is in shadow mode, or shares
        variables with such a monitor.
        """
        async with self._changing(request.expected):
            self._all_known(request.names)
            seconds = request.for_seconds
            if seconds is not None and (request.enabled or not 0 < seconds <= LONGEST):
                text = f"a monitor may be disabled for up to {LONGEST / 86_400:g} days; it is not enabled for a time"
                raise SpecificationsRefusedError([text])
            shadowed = [name for name in request.names if request.enabled and self.switches.in_shadow(name)]
            if shadowed:
                text = f"{', '.join(shadowed)} is in shadow mode: rosrv monitor enforce brings it into force"
                raise SpecificationsRefusedError([text])
            names = await self._switch(request.names, request.enabled, who, seconds)
            return self._switched(names, until=self.returns.until(names[0]) if names else None)

    async def shadow(self, request: admin.MonitorShadow, who: str) -> Switched:
        """Return the monitors that changed. With `confirm_within`, they return to shadow mode unless confirmed."""
        async with self._changing(request.expected):
            self.judge_shadow(request)
            names = await self._switch(
                request.names, SHADOW if request.shadow else True, who, request.confirm_within
            )
            return self._switched(
                names, self.rollout.began(names), confirm_by=self.returns.confirm_by(request.names[0])
            )

    def judge_shadow(self, request: admin.MonitorShadow) -> list[str]:
        self._all_known(request.names)
        disabled = [name for name in request.names if self.switches.states[name] is False]
        if disabled and not request.shadow:
            text = f"{', '.join(disabled)} is disabled, not in shadow mode: rosrv monitor enable"
            raise SpecificationsRefusedError([text])
        warnings = []
        if not request.shadow:
            others = set(self.switches.shadowed()) - set(request.names)
            warnings = self._judged(self.now, others, _Consent(request.force), promoted=request.names)
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
            if self.switches.enabled(name) and self.returns.confirm_by(name) is None
        ]
        if confirmed:
            text = f"{', '.join(confirmed)} is in force already, so it cannot wait for a confirmation"
            raise SpecificationsRefusedError([text])

    async def _come_back(self, back: Mapping[str, Switch]) -> None:
        async with self._one_change:
            for to in (True, SHADOW):
                names = [name for name in self.switches.states if back.get(name) == to]
                unconfirmed = [name for name in names if self.returns.confirm_by(name) is not None]
                disabled = [name for name in names if name not in unconfirmed]
                await self._switch(disabled, to, "its disabled period is over")
                await self._switch(unconfirmed, to, UNCONFIRMED)

    def _switched(
        self,
        names: list[str],
        began: Sequence[str] = (),
        until: float | None = None,
        confirm_by: float | None = None,
    ) -> Switched:
        return Switched(names, self.revision, self.tag, [*began], until, confirm_by)

    async def _switch(
        self, names: Sequence[str], to: Switch, who: str, seconds: float | None = None
    ) -> list[str]:
        switches = self.switches
        changed = [
            name
            for name in dict.fromkeys(names)
            if switches.states[name] != to or seconds is not None or (to is False and name in self.returns)
        ]
        if not changed:
            return changed
        new, shadow = (
            in_force.switched(self.now, changed, to),
            to == SHADOW or any(map(switches.in_shadow, changed)),
        )
        back = {name: switches.states[name] or True for name in changed}

        def store() -> None:
            # Killed between the two, control leaves a limit without its switch, never the reverse.
            if seconds is None:
                self._store_words(new)
                self.returns.end(changed)
            else:
                self.returns.begin(back, seconds, to)
                self._store_words(new)

        told = [(name, messages.MonitorSwitched(name, to is True)) for name in changed]
        await self._bring(new, store, tell=None if shadow else told)
        for name in changed:
            self._say_switched(name, to, who, earlier=switches.states[name])
        await self.store.settled()
        await self.rollout.carried_out()
        return changed

    def _say_switched(
        self, name: str, to: Switch, who: str, why: str = "", *, earlier: Switch | None
    ) -> None:
        until = self.returns.until(name) or self.returns.confirm_by(name)
        self._change_records.switched(name, to, who, why, earlier=earlier, until=until)

    def _given_states(self, name: str) -> Mapping[str, answers.GivenState]:
        return {one.name: one for one in self.givens.states(self.checked, name)}

    @property
    def off(self) -> dict[str, str]:
        """Return the monitors that are disabled or in shadow mode, each with its state in words."""
        return {name: WORDS[to] for name, to in self.switches.states.items() if to is not True}

    async def resume(self, request: admin.MonitorResume, who: str) -> Switched:
        """Release the topics that monitors hold, and let them await no node; return the monitors that held any.

        A relay that is not running is refused, because the next process will hold the topics again.
        """
        async with self._changing(request.expected):
            self._all_known(request.names)
            rows = self.rollout.rows
            held = [
                name for name in dict.fromkeys(request.names)
                if name in self.rollout.held or (name in rows and rows[name].awaits)
            ]  # fmt: skip
            take_effect()
            if held:
                await self._count(self.now.acts + 1)
                self.now = replace(self.now, acts=self.now.acts + 1)
            away = []
            for name in held:
                if not self.rollout.tell(name, messages.MonitorResumed(name)):
                    away.append(name)
                    continue
                self.rollout.resumed(name)
                self._change_records.resumed(name, who)
            if away:
                text = f"{', '.join(away)} not resumed: the relay process is not running; resume when it runs again"
                raise SpecificationsRefusedError([text])
            await self.rollout.carried_out()
            return self._switched(held)

    async def give(self, request: admin.MonitorGive, who: str) -> answers.GivenSet:
        async with self._changing(request.expected):
            name = request.name
            self._all_known([name])
            present = {one.name: one.value for one in self.givens.states(self.checked, name)}
            new = parsed(self.checked.givens.get(name, ()), name, request.values)
            changed = [one for one, value in new.items() if value != present[one]]
            if changed:
                coming = in_force.given(self.now, name, new)
                values = coming.givens.in_force(coming.checked)[name]
                await self._bring(
                    coming,
                    partial(self._store_words, coming),
                    tell=[(name, messages.MonitorGiven(name, values))],
                )
                self._change_records.given(
                    name, self._given_states(name), {one: present[one] for one in changed}, who
                )
                await self.store.settled()
                await self.rollout.carried_out()
            given = self.givens.states(self.checked, name)
            return answers.GivenSet(name, changed, given, self.revision, self.tag)

    # --- the relay's messages ---

    def received(self, message: messages.Message, relay: int = 0) -> None:
        if isinstance(message, messages.MonitorsReported):
            self.records.reported(message.events, message.lost)
            if self._ticking is None:
                self._tick()
        elif isinstance(message, messages.ValuesSeen):
            self.values.received(message)
        else:
            self.rollout.received(message, relay)

    def _tick(self) -> None:
        self.records.tick()
        going_on = self.records.some
        self._ticking = asyncio.get_running_loop().call_later(1.0, self._tick) if going_on else None

    def relay_lost(self, relay: int) -> None:
        self.rollout.lost(relay)
        self.values.relay_lost()

    async def shown(self, request: admin.MonitorValuesWanted, who: str) -> answers.MonitorReadout:
        """Return the variables of a monitor. Raises `UnknownMonitorError`."""
        self._all_known([request.name])
        return await self.values.of(request.name, who)

    # --- internals ---

    def _is_folder(self, sources: Sources) -> bool:
        found = self._folder.looked_at() if self._folder.path is not None else None
        return found is not None and found.with_topics(sources.topics) == sources

    async def _kept(self) -> list[MonitorRevisionRow]:
        await self.store.settled()
        return await super()._kept()

    def _described(self, row: MonitorRevisionRow) -> dict[str, Any]:
        return super()._described(row) | {"names": list(sources_of(row).files)}

    def _unknown(self, names: list[str]) -> str:
        return unknown_monitors(names, self.checked)

    def _all_known(self, names: list[str]) -> None:
        unknown = [name for name in names if name not in self.checked.monitors]
        if unknown:
            raise UnknownMonitorError(self._unknown(unknown))

    async def _count(self, acts: int) -> None:
        """Store the new tag before it is used, so that no crash restores an old one."""
        self.store.save_setting(_ACTS, str(acts))
        await self.store.settled()

    async def _go_back(self, revision: int) -> None:
        await self.roll_back(admin.MonitorRollback(revision), UNCONFIRMED)

    async def _bring(
        self,
        new: InForce,
        store: Callable[[], None],
        *,
        tell: Sequence[tuple[str, messages.Message]] | None = None,
    ) -> list[str]:
        """Bring the next value into force on all relays, or on none; return the monitors that began again elsewhere.

        `store` stores it, and `tell` are messages for the relays of monitors. Without them, the value is rolled out.
        An error before it is in force has changed nothing.
        """
        if tell is not None:
            take_effect()  # otherwise the rollout decides when
        if new.acts != self.now.acts:
            await self._count(new.acts)
        moved = await self.rollout.take(new) if tell is None else []
        self.now = new
        self.rollout.adopt(new)
        store()
        for name, message in tell or ():
            self.rollout.tell(name, message)
        return moved

    async def _change(
        self, wanted: Wanted, check: Callable[[Sources], Awaitable[CheckedSpecifications]], order: _Order
    ) -> Replacement:
        before = self.now
        try:
            checked = await check(wanted.sources)
            new, put, given = in_force.loaded(before, wanted, checked, signed=bool(self.site_keys))
            warnings = self._judged(new, _in_shadow(new), order.consent)
            warnings += [dropped.text for dropped in new.givens.dropped(checked)]
            kept = replace(order, warnings=warnings)
            moved = await self._bring(
                new, lambda: self._keep(before, new, kept, self.rollout.began(checked.monitors))
            )
        except SpecificationsRefusedError as error:
            others = ", ".join(order.kept)
            hint = [f"not of the folder, and kept: {others} (prune removes them)"] if others else []
            findings = error.findings + hint
            self._change_records.refused(self.revision, error.findings[0], findings, order.who)
            raise SpecificationsRefusedError(findings) from error
        for name, to in put.items():
            earlier = before.states.get(name)
            self._say_switched(name, to, order.who, ", as it was loaded", earlier=earlier)
        for name in given:
            own = {one.name: one.default for one in new.givens.states(checked, name)}
            present = own | {one.name: one.value for one in before.givens.states(before.checked, name)}
            earlier_values = {one: present[one] for one in given[name]}
            self._change_records.given(name, self._given_states(name), earlier_values, order.who)
        await self.store.settled()
        await self.rollout.all_taken()
        self._published()
        began = self.rollout.began(checked.monitors)  # also on relays that took them only now
        files = new.sources.difference(before.sources)
        done = self._replaced(before.number, files, moved, began, order.kept, loaded=order.loaded)
        return msgspec.structs.replace(done, warnings=[*done.warnings, *warnings])

    async def _strictly(self, sources: Sources) -> CheckedSpecifications:
        return await self._checks.order(sources, self.site_keys, ())

    async def _as_at_start(self, sources: Sources, known: Sequence[str] | None) -> CheckedSpecifications:
        return await self._checks.at_start(sources, self.site_keys, known)

    def _broken(self) -> dict[str, str]:
        unbuilt = {self.checked.monitors[name]: error for name, error in self.checked.unbuilt.items()}
        return self.checked.left_out | unbuilt

    async def _beside_broken(
        self, check: CheckBeside, sources: Sources, loaded: Collection[str] = ()
    ) -> CheckedSpecifications:
        """Let files that have done nothing since the start, because of an error, remain so unless they are `loaded`."""
        present, following = self.sources.named(), sources.named()
        errors = {
            file: error
            for file, error in self._broken().items()
            if file not in loaded and following.get(file) == present.get(file)
        }
        try:
            checked = await check(sources, self.site_keys, [file for file in errors if file in sources.files])
        except SpecificationsRefusedError as error:
            raise SpecificationsRefusedError([*error.findings, *map(_idle, errors)]) from error
        unusable = {file: error for file, error in errors.items() if file not in following}
        left_out = unusable | checked.left_out
        idle = left_out.keys() | {checked.monitors[name] for name in checked.unbuilt}
        warnings = [_idle(file) for file in errors if file in idle]
        return msgspec.structs.replace(checked, left_out=left_out, warnings=(*checked.warnings, *warnings))

    def _judged(
        self, coming: InForce, shadow: Collection[str], consent: _Consent, *, promoted: Collection[str] = ()
    ) -> list[str]:
        cut = judge_topics(
            coming.checked, self.checked, self._live(), shadow=shadow, forced=consent.force, promoted=promoted
        )
        held = self._held(coming, shadow, hold=consent.hold)
        if cut.conflicts or held.conflicts:
            raise SpecificationsRefusedError([*cut.conflicts, *held.conflicts, *cut.warnings, *held.warnings])
        return cut.warnings + held.warnings

    def _held(self, coming: InForce, shadow: Collection[str], *, hold: bool) -> TopicFindings:
        acting = {
            name
            for name, state in coming.states.items()
            if self.switches.enabled(name) and state and name not in shadow
        }
        return judge_holds(
            coming.checked,
            self.checked,
            self._live(),
            acting=acting - self.rollout.held,
            moved=self.rollout.moved_files(coming.checked),
            hold=hold,
        )

    def _replaced(
        self,
        before: int,
        files: tuple[list[str], list[str], list[str]],
        moved: Sequence[str] = (),
        began: Sequence[str] = (),
        kept: Sequence[str] = (),
        *,
        loaded: Collection[str] = (),
    ) -> Replacement:
        warnings, (added, changed, _removed) = list(self.checked.warnings), files
        touched = {*loaded, *added, *changed}
        states = {
            name: self.switches.states[name]
            for name, file in self.checked.monitors.items()
            if file in touched
        }
        return Replacement(
            self.revision, self.tag, before, *files, warnings, [*moved], [*began], [*kept], self.confirm_by,
            disabled=[name for name, state in states.items() if state is False],
            shadow=[name for name, state in states.items() if state == SHADOW],
            held={name: why for name, why in self.rollout.why_held.items() if name in states},
        )  # fmt: skip

    def _keep(self, earlier: InForce, new: InForce, order: _Order, began: Sequence[str] = ()) -> None:
        """Store a revision, and its predecessor with its last switches."""
        last, before, checked = self.in_force, sources_of(self.in_force), new.checked
        if last.revision:
            ended = StoredSpecifications(
                before.files,
                before.definitions,
                before.signatures,
                before.topics,
                dict(earlier.switches.said),
                {name: dict(values) for name, values in earlier.givens.said.items()},
                kept_in(last).warnings,
            )
            self.store.save_monitor_revision(last._replace(sources=text_of(ended)))
        text = text_with_warnings(new.sources, checked)
        row = MonitorRevisionRow(new.number, text, clock.wall(), order.author or order.who, order.note)
        self._put_in_force(row, order.within)
        self._enforce(new)
        added, changed, removed = new.sources.difference(before)
        self._change_records.loaded(
            row,
            before,
            new,
            order.who,
            began=began,
            off=self.off,
            changed=(added, changed, removed),
            warnings=order.warnings,
        )

    def _keep_warnings(self) -> None:
        """Store warnings that this start had to look for, as after an update from a version that did not store them."""
        text = text_with_warnings(self.sources, self.checked)
        if self.revision and text != self.in_force.sources:
            self.in_force = self.in_force._replace(sources=text)
            self.store.save_monitor_revision(self.in_force)

    def _enforce(self, new: InForce) -> None:
        earlier = self.now.states
        self.now, drawn_in, values = in_force.cleared(new)
        self.rollout.adopt(self.now)
        for name in drawn_in:
            why = ": it shares variables with one that is"
            self._say_switched(name, SHADOW, self.in_force.who, why, earlier=earlier.get(name))
        self.returns.keep(self.switches.states)
        for dropped in values:
            self._change_records.dropped(dropped, self.in_force.who)
        self._store_words(self.now)

    def _store_words(self, now: InForce) -> None:
        self.store.save_setting(SWITCHES, json.dumps(dict(now.switches.said)))
        self.store.save_setting(_GIVEN, json.dumps(dict(now.givens.said)))


def _in_shadow(coming: InForce, files: Collection[str] = ()) -> set[str]:
    found = coming.checked.monitors.items()
    return {name for name, file in found if coming.states[name] == SHADOW or file in files}


def _idle(file: str) -> str:
    fix = f"when it is corrected: rosrv monitor load {file}"
    return f"{file}:1:1: warning: it does nothing, because it has an error; {fix}"
