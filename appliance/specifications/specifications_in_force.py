"""Keep the specifications in force as one immutable value, and bring the next one into force.

1. An order makes the next value (`in_force.py`). It is checked and judged (`judgement.py`), rolled out and stored. Then
   it takes the place of the present one.
2. An error before that changes nothing: relays that have the next value get the present one again, and the store gets
   its rows and limits again. A value that was queued just before the store closes may remain stored.
3. A return that is due, as that of an unconfirmed change, does not wait for the store: a full disk must not leave a
   protection off. After a restart, the return is due again.
"""

import contextlib
import json
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import structlog

from appliance.base import clock
from appliance.base.actors import DISK, UNCONFIRMED
from appliance.base.withdrawal import take_effect
from appliance.channel import messages
from appliance.channel.answers import monitor_answers as answers
from appliance.channel.answers.monitor_answers import Replaced, findings_of
from appliance.specifications import in_force
from appliance.specifications.change_records import ChangeRecords
from appliance.specifications.givens import Givens
from appliance.specifications.in_force import Cleared, Coming, InForce, Wanted
from appliance.specifications.judgement import NO_CONSENT, Consent, Judge, in_shadow
from appliance.specifications.rollout import Rollout
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    MonitorsChangedError,
    Sources,
    SpecificationFolder,
    SpecificationsRefusedError,
)
from appliance.specifications.specification_revisions import (
    NOTHING,
    StoredSpecifications,
    kept_in,
    sources_of,
    specifications_at_start,
    text_of,
    text_with_warnings,
)
from appliance.specifications.switches import SHADOW, SWITCHES, Switch, Switches
from appliance.specifications.timed_switches import TimedSwitches
from appliance.store.ends import EndKind, EndTable
from appliance.store.revisions import Revisions
from appliance.store.state_file import MonitorRevisionRow, StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

_log = structlog.get_logger()
_ACTS = "monitor acts"
_GIVEN = "monitor given"
ALLOCATION = "relays"
SourceCheck = Callable[[Sources], Awaitable[CheckedSpecifications]]


@dataclass(frozen=True, slots=True)
class ChangeOrder:
    """The author of a change, and its terms.

    `within` is the time in which it must be confirmed. `author` is the author of the revision, unless it is `who`.
    `kept` are files that are not in the folder, `loaded` those that the operator named.
    """

    who: str
    note: str
    within: float | None = None
    consent: Consent = NO_CONSENT
    author: str = ""
    kept: Sequence[str] = ()
    loaded: Collection[str] = ()
    warnings: Sequence[str] = ()


class SpecificationsInForce(Revisions[MonitorRevisionRow]):
    """The specifications in force, their revisions, and the time limits of changes and switches."""

    refusal = SpecificationsRefusedError
    outdated = MonitorsChangedError
    unconfirmed = EndKind("confirm monitors")

    def __init__(
        self,
        folder: SpecificationFolder,
        enable: str,
        store: StateStore,
        ends: EndTable,
        trail: AuditTrail,
        *,
        rollout: Rollout,
        judge: Judge,
        site_keys: Sequence[str],
        go_back: Callable[[int], Awaitable[object]],
        come_back: Callable[[Mapping[str, Switch]], Awaitable[None]],
    ) -> None:
        """`go_back(revision)` ends an unconfirmed change, `come_back(switches)` timed switches.

        With `site_keys`, everything in force is signed.
        """
        super().__init__(store, ends, store.monitor_revisions, store.save_monitor_revision, NOTHING)
        self._folder = folder
        self._rollout = rollout
        self._judge = judge
        self._site_keys = site_keys
        self._return_to = go_back
        self.change_records = ChangeRecords(trail)
        self.returns = TimedSwitches(store, ends, come_back)
        self.now = InForce(switches=Switches(enable))

    @property
    def tag(self) -> str:
        return self.now.tag

    @property
    def differs_from_folder(self) -> bool:
        return self._folder.path is not None and not self.is_folder(self.now.sources)

    def is_folder(self, sources: Sources) -> bool:
        found = self._folder.looked_at() if self._folder.path is not None else None
        found = found and found.with_topics(sources.topics)
        return found is not None and (
            found == sources or found.without_switches() == sources.without_switches()
        )

    # --- start ---

    async def start(self, *, restarted: bool, taken_over: bool = False) -> None:
        """Bring specifications into force at the start of control.

        After a crash of control, or when it has `taken_over` from another appliance, they are those that were in
        force. At the start of the appliance, they are the folder's, unless an operator's own revision was in force.
        """
        settings = self.store.settings()
        said = self.now = _said(self.now.switches, settings)
        last = self.in_force if self.find_last(restarted=restarted or taken_over) else None
        sources, checked, refused = await specifications_at_start(
            last,
            self._folder,
            self._judge.checks.at_start,
            self._site_keys,
            named=() if restarted else said.switches.named,
            kept=self.in_force if self.revision else None,
        )
        self._bring_at_start(
            said, replace(said, number=self.revision, sources=sources, checked=checked), last
        )
        await self._rollout.start(self.now, restarted=restarted, kept=settings.get(ALLOCATION, ""))
        self._record_start(refused)
        self.returns.start(self.now.states)

    def _bring_at_start(self, said: InForce, new: InForce, last: MonitorRevisionRow | None) -> None:
        """Bring the specifications of a start into force, as a new revision if they are not those of the last one."""
        if last is not None or (self.revision and sources_of(self.in_force) == new.sources):
            self._swap(said, in_force.cleared(new))
            self._store_words(self.now)
            self._store_warnings()
            return
        self.end_limit()
        if not (new.sources.files or self.revision):
            self._swap(said, in_force.cleared(new))
            self._store_words(self.now)
            return
        order, before = ChangeOrder(DISK, "read at start"), self.in_force
        cleared = in_force.cleared(replace(new, number=self.revision + 1))
        row = self._row(cleared.now, order)
        self._store_change(said, cleared.now, row, order)
        self.in_force = row
        self._swap(said, cleared)
        self._record_loaded(before, order)

    def _store_warnings(self) -> None:
        """Store warnings that this start had to look for, as after an update from a version that did not store them."""
        text = text_with_warnings(self.now.sources, self.now.checked)
        if self.revision and text != self.in_force.sources:
            self.in_force = self.in_force._replace(sources=text)
            self.store.save_monitor_revision(self.in_force)

    def _record_start(self, refused: Sequence[str]) -> None:
        checked = self.now.checked
        if refused:
            self.change_records.folder_refused(self.revision, refused)
        for name, error in checked.unbuilt.items():
            self.change_records.unbuilt(name, checked.monitors[name], error)
        for file, error in checked.left_out.items():
            self.change_records.left_out(file, error)
        unknown = sorted(self.now.switches.named - checked.monitors.keys())
        if unknown:  # the monitors were removed while the robot ran
            _log.warning("--enable names monitors that are not loaded", monitors=unknown)

    # --- the next value ---

    async def bring(
        self,
        new: InForce,
        store: Callable[[], None] = lambda: None,
        *,
        tell: Sequence[tuple[str, messages.Message]] | None = None,
        due: bool = False,
    ) -> list[str]:
        """Bring the next value into force on all relays, or on none; return the monitors that began again elsewhere.

        `store` stores more than its words. `tell` are messages for the relays of monitors; without them, the value is
        rolled out. A return that is `due` does not wait for the store, so the caller does. Raises `StoreError` and
        `SpecificationsRefusedError`; then the present value is still in force.
        """
        if tell is not None:
            take_effect()  # otherwise the rollout decides when
        if not due:
            self._require_room()
        moved = await self._rollout.take(new) if tell is None else []
        if due:
            self._queue(new, store)
        elif problem := await self._unstored(new, store):
            if tell is None:
                await self._rollout.take_back(self.now)
            raise StoreError(self._stays(problem))
        self.now = new
        self._rollout.adopt(new)
        for name, message in tell or ():
            self._rollout.tell(name, message)
        return moved

    async def change(self, wanted: Wanted, check: SourceCheck, order: ChangeOrder) -> Replaced:
        """Make the next revision. Raises as `bring` does."""
        before, row_before, due = self.now, self.in_force, order.who == UNCONFIRMED
        try:
            checked = await check(wanted.sources)
            coming = in_force.loaded(before, wanted, checked, signed=bool(self._site_keys))
            cleared = in_force.cleared(coming.new)
            warnings = self._judge.judged(before, cleared.now, in_shadow(cleared.now), order.consent)
            places = {name: owner.position for name, owner in checked.states.items()}
            warnings += [f"{places[one.monitor]}: warning: {one.text}" for one in cleared.dropped]
            row = self._row(cleared.now, order)
            moved = await self.bring(
                cleared.now, lambda: self._store_change(before, cleared.now, row, order), due=due
            )
        except SpecificationsRefusedError as error:
            raise self._refused(error, order) from error
        except StoreError as error:
            self.change_records.refused(self.revision, "it cannot be stored", [str(error)], order.who)
            raise
        self.in_force = row
        self._record_swap(before, cleared)
        self._record_loaded(
            row_before, replace(order, warnings=warnings), self._rollout.began(checked.monitors)
        )
        self._record_words(before, coming, order.who)
        if due:
            await self.store.settled()
        await self._rollout.all_taken()
        began = self._rollout.began(checked.monitors)  # also on relays that took them only now
        files = self.now.sources.difference(before.sources)
        done = self.replaced(before.number, files, moved, began, order.kept, loaded=order.loaded)
        done.warnings.extend(findings_of(warnings))
        return done

    def replaced(
        self,
        before: int,
        files: tuple[list[str], list[str], list[str]] = ([], [], []),
        moved: Sequence[str] = (),
        began: Sequence[str] = (),
        kept: Sequence[str] = (),
        *,
        loaded: Collection[str] = (),
    ) -> Replaced:
        checked, (added, changed, removed) = self.now.checked, files
        touched = {*loaded, *added, *changed}
        states = {name: self.now.states[name] for name, file in checked.monitors.items() if file in touched}
        return Replaced(
            loaded=True, revision=self.revision, tag=self.tag, replaced=before,
            added=added, changed=changed, removed=removed, warnings=findings_of(checked.warnings),
            monitors=[*checked.monitors], moved=[*moved], began=[*began], kept=[*kept], confirm_by=self.confirm_by,
            disabled=[name for name, state in states.items() if state is False],
            shadow=[name for name, state in states.items() if state == SHADOW],
            held={name: why for name, why in self._rollout.why_held.items() if name in states},
        )  # fmt: skip

    async def _go_back(self, revision: int) -> None:
        await self._return_to(revision)

    # --- storing ---

    def _require_room(self) -> None:
        try:
            self.store.database.require_room()
        except StoreError as error:
            raise StoreError(self._stays(str(error))) from error

    async def _unstored(self, new: InForce, store: Callable[[], None]) -> str:
        """Store the next value; return why it is not stored. The store has the present one again in that case."""
        limits = [self.ends.undo(self.unconfirmed), self.returns.undo()]
        try:
            self._queue(new, store)
            if problem := await self.store.database.unwritten():
                problem += "; check the disk, and try again"
        except StoreError as error:  # the appliance is stopping
            problem = str(error)
        if problem:
            self._cancel_return()  # its limit may be that of the next value
            with contextlib.suppress(StoreError), self.store.database.together():
                for undo in limits:
                    undo()
                self._store_words(self.now)
                if new.number != self.revision:
                    self.store.forget_monitor_revision(new.number)
                    if self.revision:
                        self.store.save_monitor_revision(self.in_force)
        return problem

    def _queue(self, new: InForce, store: Callable[[], None]) -> None:
        with self.store.database.together():
            store()
            self._store_words(new)

    def _stays(self, problem: str) -> str:
        return f"revision {self.revision} of the specifications stays in force: {problem}"

    def _row(self, new: InForce, order: ChangeOrder) -> MonitorRevisionRow:
        text = text_with_warnings(new.sources, new.checked)
        return MonitorRevisionRow(new.number, text, clock.wall(), order.author or order.who, order.note)

    def _store_change(
        self, before: InForce, new: InForce, row: MonitorRevisionRow, order: ChangeOrder
    ) -> None:
        """Store a revision, and its predecessor with its last switches."""
        last = self.in_force
        if last.revision:
            kept = kept_in(last)
            ended = StoredSpecifications(
                kept.files,
                kept.definitions,
                kept.signatures,
                kept.topics,
                dict(before.switches.said),
                {name: dict(values) for name, values in before.givens.said.items()},
                kept.warnings,
            )
            self.store.save_monitor_revision(last._replace(sources=text_of(ended)))
        self.store_revision(row, order.within)
        self.returns.keep(new.states)
        self._store_words(new)

    def _store_words(self, now: InForce) -> None:
        self.store.save_setting(_ACTS, str(now.acts))
        self.store.save_setting(SWITCHES, json.dumps(dict(now.switches.said)))
        self.store.save_setting(_GIVEN, json.dumps(dict(now.givens.said)))

    # --- records ---

    def _swap(self, before: InForce, cleared: Cleared) -> None:
        self.now = cleared.now
        self._record_swap(before, cleared)

    def _record_swap(self, before: InForce, cleared: Cleared) -> None:
        for name in cleared.drawn_in:
            why = ": it shares variables with one that is"
            self.say_switched(name, SHADOW, self.in_force.who, why, earlier=before.states.get(name))
        for dropped in cleared.dropped:
            self.change_records.dropped(dropped, self.in_force.who)

    def _record_loaded(
        self, before: MonitorRevisionRow, order: ChangeOrder, began: Sequence[str] = ()
    ) -> None:
        earlier = sources_of(before)
        self.change_records.loaded(
            self.in_force,
            earlier,
            self.now,
            order.who,
            began=began,
            changed=self.now.sources.difference(earlier),
            warnings=order.warnings,
        )

    def _record_words(self, before: InForce, coming: Coming, who: str) -> None:
        """Record the monitors that a load switched, and the values that it gave."""
        for name, to in coming.put.items():
            self.say_switched(name, to, who, ", as it was loaded", earlier=before.states.get(name))
        for name in coming.given:
            own = {one.name: one.default for one in coming.new.givens.states(coming.new.checked, name)}
            present = own | {one.name: one.value for one in before.givens.states(before.checked, name)}
            earlier_values = {one: present[one] for one in coming.given[name]}
            self.change_records.given(name, self.given_states(name), earlier_values, who)

    def _refused(self, error: SpecificationsRefusedError, order: ChangeOrder) -> SpecificationsRefusedError:
        """Record the refusal, and return it with a hint about files that were kept."""
        others = ", ".join(order.kept)
        hint = [f"not of the folder, and kept: {others} (prune removes them)"] if others else []
        findings = error.findings + hint
        self.change_records.refused(self.revision, error.findings[0], findings, order.who)
        return SpecificationsRefusedError(findings)

    def say_switched(self, name: str, to: Switch, who: str, why: str = "", *, earlier: Switch | None) -> None:
        until = self.returns.until(name) or self.returns.confirm_by(name)
        self.change_records.switched(name, to, who, why, earlier=earlier, until=until)

    def given_states(self, name: str) -> Mapping[str, answers.GivenState]:
        return {one.name: one for one in self.now.givens.states(self.now.checked, name)}

    # --- revisions ---

    def described(self, row: MonitorRevisionRow) -> dict[str, Any]:
        return super().described(row) | {"names": list(sources_of(row).files)}


def _said(switches: Switches, settings: Mapping[str, str]) -> InForce:
    """Return the words of operators about monitors, as they are stored."""
    return InForce(
        switches=switches.saying(json.loads(settings.get(SWITCHES, "{}"))),
        givens=Givens(json.loads(settings.get(_GIVEN, "{}"))),
        acts=int(settings.get(_ACTS, "0")),
    )
