"""The specifications in force: load, switch, roll back, and answer operators.

Here are the orders of operators. `specifications_in_force.py` brings what they ask for into force.

1. The appliance never writes to the folder of specifications. Changes are revisions in the store; revisions and
   switches survive a restart.
2. If a text has errors, or a relay refuses its compiled form, nothing changes.
3. A load or switch of other monitors never takes an existing monitor out of force.
4. Files that are not in the folder stay in force unless a reload prunes, so a missing file ends no protection.
5. Each revision is stored with its last switches, so a rollback restores its monitors as they were.
6. Each change gets a new tag, which never repeats; a change that expects another tag is refused.
"""

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial

import msgspec

from appliance.base.actors import DISK, UNCONFIRMED
from appliance.base.withdrawal import take_effect
from appliance.channel import admin, messages
from appliance.channel.answers import monitor_answers as answers
from appliance.channel.answers.monitor_answers import Replacement, Switched
from appliance.specifications import in_force
from appliance.specifications.givens import parsed, split
from appliance.specifications.in_force import Wanted, unknown_monitors
from appliance.specifications.judgement import Consent, broken, in_shadow
from appliance.specifications.specification_files import Sources, SpecificationsRefusedError
from appliance.specifications.specification_revisions import NOTHING, kept_in, sources_of
from appliance.specifications.specifications_in_force import ChangeOrder, SpecificationsInForce
from appliance.specifications.switches import SHADOW, Switch
from appliance.specifications.timed_switches import LONGEST
from appliance.store.revisions import reloaded_by

_NO_FOLDER = (
    "no folder of specifications is configured, so there is nothing to reload, and nothing was changed: start with"
    " --monitors DIR (monitors: DIR in appliance.yaml), or load files: rosrv monitor load FILE"
)
_NO_FILES: tuple[list[str], list[str], list[str]] = ([], [], [])
_ALL = Consent(force=True, hold=True)
"""The consent of a rollback, which must never fail."""


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


class SpecificationManager(SpecificationsInForce):
    """The orders of operators about specifications.

    They are carried out one at a time; they raise `SpecificationsRefusedError` and `UnknownMonitorError`.
    """

    outdated = MonitorsChangedError

    @cached_property
    def _attempting(self) -> set[str]:
        """The clients with a dry run under way."""
        return set()

    # --- queries ---

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

    async def shown(self, request: admin.MonitorValuesWanted, who: str) -> answers.MonitorReadout:
        """Return the variables of a monitor. Raises `UnknownMonitorError`."""
        self._all_known([request.name])
        return await self.values.of(request.name, who)

    # --- orders ---

    async def load(self, request: admin.MonitorLoad, who: str, *, enable: bool = False) -> Replacement:
        """Load specifications.

        With `enable`, monitors are enabled even if the setting `enable` would disable them. With `confirm_within`, the
        change is rolled back after that many seconds unless confirmed.
        """
        async with self._changing(request.expected):
            topics, constants = split(request.given)
            new = Sources(request.files, request.definitions, request.signatures, topics)
            sources = self.sources.with_files(new)
            asks = request.shadow or request.given or new.files.keys() & broken(self.now).keys()
            if self.in_force.who != DISK and sources == self.sources and not asks:
                return self._replaced(
                    self.revision, _NO_FILES, loaded=new.files
                )  # same texts: no new revision
            files = frozenset(new.files)
            shadow, enabled = files if request.shadow else (), files if enable else ()
            order = ChangeOrder(
                who, request.note or "loaded", request.confirm_within, Consent(request.force, request.hold),
                loaded=files,
            )  # fmt: skip
            check = partial(self.judge.beside_broken, self.now, self.judge.checks.order, loaded=files)
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
            consent = Consent(request.force, request.hold)
            order = ChangeOrder(
                who, reloaded_by(who), request.confirm_within, consent, author=keeper, kept=kept
            )
            return await self._change(Wanted(sources, shadow), self.judge.strictly, order)

    async def take_bundle(self, sources: Sources, who: str, note: str) -> Replacement:
        """Bring exactly these sources into force."""
        async with self._changing(None):
            sources = sources.with_topics(self.sources.topics)
            if self.in_force.who != DISK and sources == self.sources:
                return self._replaced(self.revision, _NO_FILES)  # same texts: no new revision
            order = ChangeOrder(who, note, consent=Consent(hold=True))
            return await self._change(Wanted(sources), self.judge.strictly, order)

    async def held_by_bundle(self, sources: Sources) -> list[str]:
        sources = sources.with_topics(self.sources.topics)
        if sources == self.sources:
            return []
        coming = replace(self.now, sources=sources, checked=await self.judge.strictly(sources))
        return self.judge.held(self.now, coming, in_shadow(coming), hold=False).conflicts

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
            check = partial(self.judge.beside_broken, self.now, self.judge.checks.order)
            return await self._change(Wanted(sources), check, ChangeOrder(who, note, within, author=keeper))

    async def roll_back(self, request: admin.MonitorRollback, who: str) -> Replacement:
        """Bring a revision into force again: None is the previous revision, 0 no specifications.

        The rollback of an unconfirmed change must succeed, so a file with an error does nothing, as after a start.
        """
        async with self._changing(request.expected):
            row = NOTHING if request.revision == 0 else await self._wanted(request.revision)
            note, last = f"rolled back to revision {row.revision}", kept_in(row)
            as_before = partial(self.judge.as_at_start, known=last.warnings)
            check = as_before if who == UNCONFIRMED else self.judge.strictly
            wanted = Wanted(sources_of(row), switches=last.switches, given=last.given)
            return await self._change(wanted, check, ChangeOrder(who, note, consent=_ALL))

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

    async def _go_back(self, revision: int) -> None:
        await self.roll_back(admin.MonitorRollback(revision), UNCONFIRMED)

    def _unknown(self, names: list[str]) -> str:
        return unknown_monitors(names, self.checked)

    def _all_known(self, names: list[str]) -> None:
        unknown = [name for name in names if name not in self.checked.monitors]
        if unknown:
            raise UnknownMonitorError(self._unknown(unknown))
