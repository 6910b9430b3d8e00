"""Keep the specifications in force as one immutable value, and bring the next one into force.

An order makes the next value (`in_force.py`). It is checked and judged (`judgement.py`) and rolled out. Then it takes
the place of the present one, and is stored. An error before that has changed nothing.
"""

import asyncio
import json
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import structlog

from appliance.base import clock
from appliance.base.actors import DISK
from appliance.base.withdrawal import take_effect
from appliance.channel import messages
from appliance.channel.answers import monitor_answers as answers
from appliance.channel.answers.monitor_answers import Replacement
from appliance.specifications import in_force
from appliance.specifications.allocation import Allocation
from appliance.specifications.change_records import WORDS, ChangeRecords
from appliance.specifications.givens import Givens
from appliance.specifications.in_force import Coming, InForce, Wanted
from appliance.specifications.judgement import NO_CONSENT, Checks, Consent, Judge, in_shadow
from appliance.specifications.live_topics import Published
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
from appliance.specifications.timed_switches import TimedSwitches
from appliance.store.ends import EndKind, EndTable
from appliance.store.revisions import Revisions
from appliance.store.state_file import MonitorRevisionRow, StateStore
from appliance.telemetry.audit_trail import AuditTrail

_log = structlog.get_logger()
_ACTS = "monitor acts"
_STOPS = "monitor stops"
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
    """The specifications in force.

    `published()` is called when monitors may publish other topics. With `site_keys`, everything in force is signed.
    """

    refusal = SpecificationsRefusedError
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
        self._change_records = ChangeRecords(trail)
        self.now = InForce(switches=Switches(enable))
        self.rollout = Rollout(allocation, trail, on_fault, relays, slices=slices, parts=parts)
        self.judge = Judge(
            Checks(check, check_at_start, try_out),
            site_keys,
            live,
            held=lambda: self.rollout.held,
            moved=self.rollout.moved_files,
        )
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

    @abstractmethod
    async def _come_back(self, back: Mapping[str, Switch]) -> None:
        """Switch monitors back whose time is over."""

    # --- start ---

    async def start(self, *, restarted: bool, taken_over: bool = False) -> None:
        """Bring specifications into force at the start of control.

        After a crash of control, or when it has `taken_over` from another appliance, they are those that were in
        force. At the start of the appliance, they are the folder's, unless an operator's own revision was in force.
        """
        settings = self.store.settings()
        said = self.now = _said(self.switches, settings)
        self.records.start(settings.get(_STOPS, "[]"))
        last = self.in_force if self._find_last(restarted=restarted or taken_over) else None
        sources, checked, refused = await specifications_at_start(
            last,
            self._folder,
            self.judge.checks.at_start,
            self.site_keys,
            named=() if restarted else self.switches.named,
            kept=self.in_force if self.revision else None,
        )
        self._bring_at_start(
            said, replace(said, number=self.revision, sources=sources, checked=checked), last
        )
        await self.rollout.start(self.now, restarted=restarted, kept=settings.get(ALLOCATION, ""))
        self._record_start(refused)
        self.returns.start(self.switches.states)

    def _bring_at_start(self, said: InForce, new: InForce, last: MonitorRevisionRow | None) -> None:
        """Bring the specifications of a start into force, as a new revision if they are not those of the last one."""
        if last is not None or (self.revision and sources_of(self.in_force) == new.sources):
            self._enforce(new)
            self._keep_warnings()
            return
        self._end_limit()
        if new.sources.files or self.revision:
            self._keep(said, replace(new, number=self.revision + 1), ChangeOrder(DISK, "read at start"))
        else:
            self._enforce(new)

    def _record_start(self, refused: Sequence[str]) -> None:
        if refused:
            self._change_records.folder_refused(self.revision, refused)
        for name, error in self.checked.unbuilt.items():
            self._change_records.unbuilt(name, self.checked.monitors[name], error)
        for file, error in self.checked.left_out.items():
            self._change_records.left_out(file, error)
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

    def statement(self, relay: int) -> messages.SpecificationsStated:
        return self.rollout.statement(relay)

    @property
    def off(self) -> dict[str, str]:
        """Return the monitors that are disabled or in shadow mode, each with its state in words."""
        return {name: WORDS[to] for name, to in self.switches.states.items() if to is not True}

    # --- changing ---

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

    async def _change(self, wanted: Wanted, check: SourceCheck, order: ChangeOrder) -> Replacement:
        before = self.now
        try:
            checked = await check(wanted.sources)
            coming = in_force.loaded(before, wanted, checked, signed=bool(self.site_keys))
            warnings = self.judge.judged(before, coming.new, in_shadow(coming.new), order.consent)
            warnings += [dropped.text for dropped in coming.new.givens.dropped(checked)]
            kept = replace(order, warnings=warnings)
            moved = await self._bring(
                coming.new,
                lambda: self._keep(before, coming.new, kept, self.rollout.began(checked.monitors)),
            )
        except SpecificationsRefusedError as error:
            raise self._refused(error, order) from error
        self._record_words(before, coming, order.who)
        await self.store.settled()
        await self.rollout.all_taken()
        self._published()
        began = self.rollout.began(checked.monitors)  # also on relays that took them only now
        files = coming.new.sources.difference(before.sources)
        done = self._replaced(before.number, files, moved, began, order.kept, loaded=order.loaded)
        return msgspec.structs.replace(done, warnings=[*done.warnings, *warnings])

    def _refused(self, error: SpecificationsRefusedError, order: ChangeOrder) -> SpecificationsRefusedError:
        """Record the refusal, and return it with a hint about files that were kept."""
        others = ", ".join(order.kept)
        hint = [f"not of the folder, and kept: {others} (prune removes them)"] if others else []
        findings = error.findings + hint
        self._change_records.refused(self.revision, error.findings[0], findings, order.who)
        return SpecificationsRefusedError(findings)

    def _record_words(self, before: InForce, coming: Coming, who: str) -> None:
        """Record the monitors that a load switched, and the values that it gave."""
        for name, to in coming.put.items():
            self._say_switched(name, to, who, ", as it was loaded", earlier=before.states.get(name))
        for name in coming.given:
            own = {one.name: one.default for one in coming.new.givens.states(coming.new.checked, name)}
            present = own | {one.name: one.value for one in before.givens.states(before.checked, name)}
            earlier_values = {one: present[one] for one in coming.given[name]}
            self._change_records.given(name, self._given_states(name), earlier_values, who)

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

    def _keep(self, earlier: InForce, new: InForce, order: ChangeOrder, began: Sequence[str] = ()) -> None:
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

    async def _count(self, acts: int) -> None:
        """Store the new tag before it is used, so that no crash restores an old one."""
        self.store.save_setting(_ACTS, str(acts))
        await self.store.settled()

    def _say_switched(
        self, name: str, to: Switch, who: str, why: str = "", *, earlier: Switch | None
    ) -> None:
        until = self.returns.until(name) or self.returns.confirm_by(name)
        self._change_records.switched(name, to, who, why, earlier=earlier, until=until)

    def _given_states(self, name: str) -> Mapping[str, answers.GivenState]:
        return {one.name: one for one in self.givens.states(self.checked, name)}

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

    # --- internals ---

    def _is_folder(self, sources: Sources) -> bool:
        found = self._folder.looked_at() if self._folder.path is not None else None
        return found is not None and found.with_topics(sources.topics) == sources

    async def _kept(self) -> list[MonitorRevisionRow]:
        await self.store.settled()
        return await super()._kept()

    def _described(self, row: MonitorRevisionRow) -> dict[str, Any]:
        return super()._described(row) | {"names": list(sources_of(row).files)}


def _said(switches: Switches, settings: Mapping[str, str]) -> InForce:
    """Return the words of operators about monitors, as they are stored."""
    return InForce(
        switches=switches.saying(json.loads(settings.get(SWITCHES, "{}"))),
        givens=Givens(json.loads(settings.get(_GIVEN, "{}"))),
        acts=int(settings.get(_ACTS, "0")),
    )
