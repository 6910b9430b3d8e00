"""The specifications in force: load, switch, roll back, and answer operators.

Here are the orders of operators, and the messages of relays. `specifications_in_force.py` brings what operators order
into force.

1. The appliance never writes to the folder of specifications. Changes are revisions in the store; revisions and
   switches survive a restart.
2. If a text has errors, or a relay refuses its compiled form, nothing changes.
3. A load or switch of other monitors never takes an existing monitor out of force.
4. Files that are not in the folder stay in force unless a reload prunes, so a missing file ends no protection.
5. Each revision is stored with its last switches, so a rollback restores its monitors as they were.
6. Each change gets a new tag, which never repeats; a change that expects another tag is refused.
"""

import asyncio
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import msgspec

from appliance.base.actors import DISK, UNCONFIRMED
from appliance.channel import admin, messages
from appliance.channel.answers import monitor_answers as answers
from appliance.channel.answers.monitor_answers import Replaced, Switched, findings_of
from appliance.specifications import in_force
from appliance.specifications.allocation import Allocation
from appliance.specifications.change_records import off_in
from appliance.specifications.givens import Givens, parsed, split
from appliance.specifications.in_force import InForce, Wanted, unknown_monitors
from appliance.specifications.judgement import Checks, Consent, Judge, broken, in_shadow
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
    Check,
    CheckBeside,
    kept_in,
    sources_of,
)
from appliance.specifications.specifications_in_force import (
    ChangeOrder,
    SourceCheck,
    SpecificationsInForce,
)
from appliance.specifications.switches import SHADOW, Switch, Switches, word_of
from appliance.specifications.timed_switches import LONGEST
from appliance.store.ends import EndTable
from appliance.store.revisions import reloaded_by
from appliance.store.state_file import MonitorRevisionRow, StateStore
from appliance.telemetry.audit_trail import AuditTrail
from rosmop.form.switch_words import Word, file_switch

_NO_FOLDER = (
    "no folder of specifications is configured, so there is nothing to reload, and nothing was changed: start with"
    " --monitors DIR (monitors: DIR in appliance.yaml), or load files: rosrv monitor load FILE"
)
_STOPS = "monitor stops"
_ALL = Consent(force=True, hold=True)
"""The consent of a rollback, which must never fail."""


class UnknownMonitorError(Exception):
    """A monitor, file or revision does not exist."""


class DryRunUnderWayError(Exception):
    """A client may have only one dry run at a time."""


class SpecificationManager:
    """The orders of operators about specifications, and what the relays report about monitors.

    Orders are carried out one at a time. They raise `SpecificationsRefusedError`, `UnknownMonitorError`, and
    `StoreError`, which has changed nothing.
    """

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
        self._folder = SpecificationFolder(folder)
        self.site_keys = site_keys
        self.rollout = Rollout(allocation, trail, on_fault, relays, slices=slices, parts=parts)
        self.judge = Judge(
            Checks(check, check_at_start, try_out),
            site_keys,
            live,
            held=lambda: self.rollout.held,
            moved=self.rollout.moved_files,
        )
        self.present = SpecificationsInForce(
            self._folder,
            enable,
            store,
            ends,
            trail,
            rollout=self.rollout,
            judge=self.judge,
            site_keys=site_keys,
            go_back=self._go_back,
            come_back=self._come_back,
        )
        self.returns = self.present.returns
        self._change_records = self.present.change_records
        self.records = MonitorRecords(
            trail,
            lambda topic, data: self.checked.fields(topic, data),  # noqa: PLW0108 - of whatever is in force then
            [*told],
            lambda stops: store.save_setting(_STOPS, stops),
        )
        self.values = MonitorValues(self.rollout.tell, lambda: self.revision, trail)
        self._store = store
        self._published = published
        self._ticking: asyncio.TimerHandle | None = None
        self._attempting: set[str] = set()  # the clients with a dry run under way

    async def start(self, *, restarted: bool, taken_over: bool = False) -> None:
        """As `SpecificationsInForce.start`."""
        self.records.start(self._store.settings().get(_STOPS, "[]"))
        await self.present.start(restarted=restarted, taken_over=taken_over)

    # --- queries ---

    @property
    def now(self) -> InForce:
        return self.present.now

    @property
    def in_force(self) -> MonitorRevisionRow:
        return self.present.in_force

    @property
    def confirm_by(self) -> float | None:
        return self.present.confirm_by

    @property
    def differs_from_folder(self) -> bool:
        return self.present.differs_from_folder

    @property
    def folder(self) -> Path | None:
        return self._folder.path

    @property
    def revision(self) -> int:
        return self.now.number

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
        return word_of(self.returns.lasting(name, self.switches.states[name]))

    def afresh(self, name: str) -> Word | None:
        """Return how a monitor would begin with a new state directory; None if its file is not in the folder."""
        found = self._folder.looked_at()
        text = found.files.get(self.checked.monitors[name]) if found is not None else None
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
        rows = [self.present.described(row) for row in await self.present.rows()]
        return answers.MonitorRevisionList(msgspec.convert(rows, list[answers.MonitorRevision]))

    async def texts(self, request: admin.MonitorRevisionWanted) -> answers.RevisionTexts:
        row = await self.present.find(request.revision)
        if row is None:
            raise UnknownMonitorError(
                f"there is no revision {request.revision} of the specifications: rosrv monitor revisions lists all"
            )
        texts = msgspec.structs.asdict(sources_of(row))
        return msgspec.convert(self.present.described(row) | texts, answers.RevisionTexts)

    async def shown(self, request: admin.MonitorValuesWanted, who: str) -> answers.MonitorReadout:
        """Return the variables of a monitor. Raises `UnknownMonitorError`."""
        self._all_known([request.name])
        return await self.values.of(request.name, who)

    # --- orders ---

    async def load(self, request: admin.MonitorLoad, who: str, *, enable: bool = False) -> Replaced:
        """Load specifications.

        With `enable`, monitors are enabled even if the setting `enable` would disable them. With `confirm_within`, the
        change is rolled back after that many seconds unless confirmed.
        """
        async with self.present.changing(request.expected):
            topics, constants = split(request.given)
            new = Sources(request.files, request.definitions, request.signatures, topics)
            sources = self.sources.with_files(new)
            asks = request.shadow or request.given or new.files.keys() & broken(self.now).keys()
            if self.in_force.who != DISK and sources == self.sources and not asks:
                return self.present.replaced(self.revision, loaded=new.files)  # same texts: no new revision
            files = frozenset(new.files)
            shadow, enabled = files if request.shadow else (), files if enable else ()
            order = ChangeOrder(
                who, request.note or "loaded", request.confirm_within, Consent(request.force, request.hold),
                loaded=files,
            )  # fmt: skip
            check = partial(self.judge.beside_broken, self.now, self.judge.checks.order, loaded=files)
            return await self._change(Wanted(sources, shadow, enabled, topics, constants), check, order)

    async def attempt(self, asked: admin.MonitorTry, who: str) -> Replaced:
        request = self._as_load(asked.order)
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
            checked = await self.judge.beside_broken(
                self.now, self.judge.checks.dry_run, following, request.files
            )
            in_force.constants_of(
                Wanted(following, topics=topics, constants=constants), checked, signed=bool(self.site_keys)
            )
        finally:
            self._attempting.discard(who)
        coming = replace(self.now, sources=following, checked=checked)
        shadow = in_shadow(coming, request.files if request.shadow else ())
        warnings = self.judge.judged(self.now, coming, shadow, Consent(request.force, request.hold))
        files = following.difference(present)
        found = findings_of([*checked.warnings, *warnings])
        return Replaced(
            loaded=False, revision=revision, tag=tag, added=files[0], changed=files[1], removed=files[2],
            warnings=found, monitors=[*checked.monitors],
        )  # fmt: skip

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
        )

    async def reload(self, request: admin.MonitorReload, who: str) -> Replaced:
        """Load the folder; files that are not in it stay in force, unless `prune` is set.

        The same texts make no new revision, unless one has an error or waits for a confirmation.
        """
        async with self.present.changing(request.expected):
            if self._folder.path is None:
                raise SpecificationsRefusedError([_NO_FOLDER])
            sources = await asyncio.to_thread(self._folder.read)
            sources = sources.with_topics(self.sources.topics)
            kept = [] if request.prune else sorted(self.sources.files.keys() - sources.files.keys())
            if kept:
                sources = self.sources.with_files(sources)
            keeper = who if kept else DISK  # with `DISK`, the next start would read only the folder
            same = sources == self.sources and (self.in_force.who == DISK) == (keeper == DISK)
            if same and not broken(self.now) and self.confirm_by is None:
                return self.present.replaced(self.revision, kept=kept)
            added, changed, _removed = sources.difference(self.sources)
            shadow = frozenset([*added, *changed]) if request.shadow else frozenset()
            consent = Consent(request.force, request.hold)
            order = ChangeOrder(
                who, reloaded_by(who), request.confirm_within, consent, author=keeper, kept=kept
            )
            return await self._change(Wanted(sources, shadow), self.judge.strictly, order)

    async def take_bundle(self, sources: Sources, who: str, note: str) -> Replaced:
        """Bring exactly these sources into force."""
        async with self.present.changing(None):
            sources = sources.with_topics(self.sources.topics)
            if self.in_force.who != DISK and sources == self.sources:
                return self.present.replaced(self.revision)  # same texts: no new revision
            order = ChangeOrder(who, note, consent=Consent(hold=True))
            return await self._change(Wanted(sources), self.judge.strictly, order)

    async def held_by_bundle(self, sources: Sources) -> list[str]:
        sources = sources.with_topics(self.sources.topics)
        if sources == self.sources:
            return []
        coming = replace(self.now, sources=sources, checked=await self.judge.strictly(sources))
        return self.judge.held(self.now, coming, in_shadow(coming), hold=False).conflicts

    async def remove(self, request: admin.MonitorRemove, who: str) -> Replaced:
        """Remove files, or the files of monitors, if no other monitor is in them or uses their variables."""
        async with self.present.changing(request.expected):
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
            if within is None and self.present.is_folder(sources):
                keeper = DISK  # the baseline again, so the next start reads the folder
            check = partial(self.judge.beside_broken, self.now, self.judge.checks.order)
            return await self._change(Wanted(sources), check, ChangeOrder(who, note, within, author=keeper))

    async def roll_back(self, request: admin.MonitorRollback, who: str) -> Replaced:
        """Bring a revision into force again: None is the previous revision, 0 no specifications.

        The rollback of an unconfirmed change must succeed, so a file with an error does nothing, as after a start.
        """
        async with self.present.changing(request.expected):
            row = NOTHING if request.revision == 0 else await self.present.wanted(request.revision)
            note, last = f"rolled back to revision {row.revision}", kept_in(row)
            as_before = partial(self.judge.as_at_start, known=last.warnings)
            check = as_before if who == UNCONFIRMED else self.judge.strictly
            wanted = Wanted(sources_of(row), switches=last.switches, given=last.given)
            return await self._change(wanted, check, ChangeOrder(who, note, consent=_ALL))

    async def confirm(self, request: admin.MonitorConfirm, who: str) -> answers.MonitorsConfirmed:
        async with self.present.changing(request.expected):
            promoted = self.returns.unconfirmed()
            waited = self.confirm_by is not None or bool(promoted)
            if waited:
                self.present.end_limit()
                self.returns.end(promoted)
                self._change_records.confirmed(self.revision, promoted, who)
                await self._store.settled()
            return answers.MonitorsConfirmed(waited, self.revision, self.tag)

    async def switch(self, request: admin.MonitorSwitch, who: str) -> Switched:
        """Switch monitors; return those that changed. A monitor is not enabled if it is in shadow mode, or shares
        variables with such a monitor.
        """
        async with self.present.changing(request.expected):
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
        async with self.present.changing(request.expected):
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
            warnings = self.judge.judged(
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
            if self.switches.enabled(name) and self.returns.confirm_by(name) is None
        ]
        if confirmed:
            text = f"{', '.join(confirmed)} is in force already, so it cannot wait for a confirmation"
            raise SpecificationsRefusedError([text])

    async def _come_back(self, back: Mapping[str, Switch]) -> None:
        async with self.present.changing(None):
            for to in (True, SHADOW):
                names = [name for name in self.switches.states if back.get(name) == to]
                unconfirmed = [name for name in names if self.returns.confirm_by(name) is not None]
                disabled = [name for name in names if name not in unconfirmed]
                await self._switch(disabled, to, "its disabled period is over", due=True)
                await self._switch(unconfirmed, to, UNCONFIRMED, due=True)

    def _switched(
        self,
        names: list[str],
        began: Sequence[str] = (),
        until: float | None = None,
        confirm_by: float | None = None,
    ) -> Switched:
        return Switched(names, self.revision, self.tag, [*began], until, confirm_by)

    async def _switch(
        self,
        names: Sequence[str],
        to: Switch,
        who: str,
        seconds: float | None = None,
        *,
        due: bool = False,
    ) -> list[str]:
        switches = self.switches
        changed = [
            name
            for name in dict.fromkeys(names)
            if switches.states[name] != to
            or seconds is not None
            or (to is False and name in self.returns)
            or (to is not True and name not in switches.said)  # it is off by the setting, and now by an order
        ]
        if not changed:
            return changed
        new, shadow = (
            in_force.switched(self.now, changed, to),
            to == SHADOW or any(map(switches.in_shadow, changed)),
        )
        back = {name: switches.states[name] or True for name in changed}

        def store() -> None:
            if seconds is None:
                self.returns.end(changed)
            else:
                self.returns.begin(back, seconds, to)

        told = [(name, messages.MonitorSwitched(name, to is True)) for name in changed]
        await self.present.bring(new, store, tell=None if shadow else told, due=due)
        for name in changed:
            self.present.say_switched(name, to, who, earlier=switches.states[name])
        if due:
            await self._store.settled()
        await self.rollout.carried_out()
        return changed

    async def resume(self, request: admin.MonitorResume, who: str) -> Switched:
        """Release the topics that monitors hold, and let them await no node; return the monitors that held any.

        A relay that is not running is refused, because the next process will hold the topics again.
        """
        async with self.present.changing(request.expected):
            self._all_known(request.names)
            rows = self.rollout.rows
            held = [
                name for name in dict.fromkeys(request.names)
                if name in self.rollout.held or (name in rows and rows[name].awaits)
            ]  # fmt: skip
            if held:
                await self.present.bring(replace(self.now, acts=self.now.acts + 1), tell=())
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
        async with self.present.changing(request.expected):
            name = request.name
            self._all_known([name])
            present = {one.name: one.value for one in self.givens.states(self.checked, name)}
            new = parsed(self.checked.givens.get(name, ()), name, request.values)
            changed = [one for one, value in new.items() if value != present[one]]
            if changed:
                coming = in_force.given(self.now, name, new)
                values = coming.givens.in_force(coming.checked)[name]
                await self.present.bring(coming, tell=[(name, messages.MonitorGiven(name, values))])
                self._change_records.given(
                    name, self.present.given_states(name), {one: present[one] for one in changed}, who
                )
                await self.rollout.carried_out()
            given = self.givens.states(self.checked, name)
            return answers.GivenSet(name, changed, given, self.revision, self.tag)

    async def _change(self, wanted: Wanted, check: SourceCheck, order: ChangeOrder) -> Replaced:
        try:
            return await self.present.change(wanted, check, order)
        finally:
            self._published()

    async def _go_back(self, revision: int) -> None:
        await self.roll_back(admin.MonitorRollback(revision), UNCONFIRMED)

    # --- messages of relays ---

    def received(self, message: messages.Message, relay: int = 0) -> None:
        if isinstance(message, messages.MonitorsReported):
            self.records.reported(message.events, message.lost)
            if self._ticking is None:
                self._tick()
        elif isinstance(message, messages.ValuesSeen):
            self.values.received(message)
        else:
            self.rollout.received(message, relay)

    def relay_lost(self, relay: int) -> None:
        self.rollout.lost(relay)
        self.values.relay_lost()

    def _tick(self) -> None:
        self.records.tick()
        going_on = self.records.some
        self._ticking = asyncio.get_running_loop().call_later(1.0, self._tick) if going_on else None

    # --- inside ---

    def _unknown(self, names: list[str]) -> str:
        return unknown_monitors(names, self.checked)

    def _all_known(self, names: list[str]) -> None:
        unknown = [name for name in names if name not in self.checked.monitors]
        if unknown:
            raise UnknownMonitorError(self._unknown(unknown))
