"""Has the relays take the specifications: each those files that are its own, all of them or none.

A load is tried first: every relay that gives nothing up is told what it is to have, before anything is carried
elsewhere; so is one that comes meanwhile. When all have taken it, what moves is withdrawn where it was, the allocation
changes, and it is placed where its monitors are now: no message goes past its monitors. Those that give something up
are told then; a load is over when they have said so (`all_taken`). A monitor whose file moves loses its state, which is
with the relay that it was on: what acts by a state holds its topics then.
"""

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from appliance.audit.record import Severity
from appliance.base.withdrawal import take_effect
from appliance.channel import messages
from appliance.specifications.allocation import Allocation, Plan
from appliance.specifications.relay_needs import Relays
from appliance.specifications.specification_files import Checked, Sources, SpecificationsRefusedError
from appliance.telemetry.audit_trail import AuditTrail

TRIAL: Literal["on trial"] = "on trial"
Switch = bool | Literal["on trial"]
"""Whether what a monitor does is done; on trial it is only told."""

_RELAY_SECONDS = 15.0
_TRIES = 5  # while nodes that are affected register and go
_SILENT = f"a relay does not answer within {_RELAY_SECONDS:g} s"


@dataclass(frozen=True, slots=True)
class Revision:
    """Specifications in force, or about to be."""

    number: int = 0
    sources: Sources = field(default_factory=Sources)
    checked: Checked = field(default_factory=Checked)
    trials: frozenset[str] = frozenset()
    """The monitors that are on trial."""


Parts = Callable[[bytes, list[messages.PartNames]], Awaitable[list[bytes]]]
"""What each of some relays runs of a set that was compiled. Raises `SpecificationsRefusedError`."""


@dataclass(slots=True)
class Rollout:
    """What the relays were told and what they said; `states(checked)` says of each monitor whether it is in force.

    Relays are told what the compiler made for them alone (`parts`), before anything is said of it.
    `rows` has state and counters of the monitors, as far as their relays have told.
    """

    allocation: Allocation
    trail: AuditTrail
    on_fault: Literal["drop", "pass"]
    states: Callable[[Checked], Mapping[str, Switch]]
    relays: Relays
    slices: int
    parts: Parts
    rows: dict[str, messages.MonitorRow] = field(default_factory=dict)
    _now: Revision = field(default_factory=Revision)
    # What relays run of what is in force, and of what is being tried.
    _parts: dict[tuple[bytes, messages.PartNames], bytes] = field(default_factory=dict)
    _known: set[int] = field(default_factory=set)  # relays that had specifications before
    _fresh: set[int] = field(default_factory=set)  # relays that have not answered since they are there
    _coming: tuple[Revision, Plan] | None = None  # being tried
    # Of those that gave something up.
    _answers: dict[int, asyncio.Future[list[str]]] = field(default_factory=dict)
    # By relay and statement.
    _waiting: dict[tuple[int, int], asyncio.Future[list[str]]] = field(default_factory=dict)
    # Relays may outlive control: no number comes again.
    _numbers: Iterator[int] = field(default_factory=lambda: itertools.count(time.monotonic_ns()))
    _refusals: dict[int, list[str]] = field(default_factory=dict)
    _began: set[str] = field(default_factory=set)  # by what is being changed
    _held: dict[int, dict[str, str]] = field(default_factory=dict)
    _rows: dict[int, list[messages.MonitorRow]] = field(default_factory=dict)

    @property
    def refused(self) -> list[str]:
        """Why a relay does not take what is in force; empty when all do."""
        return [finding for findings in self._refusals.values() for finding in findings]

    @property
    def held(self) -> set[str]:
        """The monitors that hold their topics."""
        return set(self.why_held)

    @property
    def why_held(self) -> dict[str, str]:
        """The monitors that hold their topics, and why their state was lost (empty: it was not)."""
        return {name: why for names in self._held.values() for name, why in names.items()}

    async def start(self, now: Revision, *, restarted: bool, kept: str) -> None:
        """These are in force. After a crash of control (`restarted`) the relays go on with what they have.

        Raises `SpecificationsRefusedError`.
        """
        self._now = now
        if restarted:
            self._known = set(range(self.allocation.relays))
        carried = self.allocation.resources if restarted and self.allocation.restore(kept) else ()
        # what was kept may be of a change that control did not survive: then it is made to fit, as little as can be
        self.allocation.adopt(self.allocation.plan(now.checked, carried))
        await self._make(now, self.allocation.of_file)

    def statement(self, relay: int) -> messages.SpecificationsStated:
        """What a relay is told before anything else; one that follows another must hold what is to be held."""
        restarted = relay in self._known
        self._known.add(relay)
        (self._fresh.add if restarted else self._fresh.discard)(relay)
        if self._coming is not None and relay not in self._coming[1].losing:
            coming, plan = self._coming
            return self._statement(
                coming, relay, _of(plan), plan.moved_files, restarted=restarted, ahead=True
            )
        return self._statement(self._now, relay, self.allocation.of_file, restarted=restarted, ahead=True)

    def relay_of(self, monitor: str) -> int:
        """The relay that has a monitor."""
        return self.allocation.of_file(self._now.checked.monitors[monitor])

    def tell(self, monitor: str, message: messages.Message) -> bool:
        """Tell the relay that has a monitor; False when it is not there."""
        return self.relays.send(message, self.relay_of(monitor))

    async def carried_out(self) -> None:
        """Wait until the relays have done what they were told: what comes after the answer is judged by it."""
        await self.relays.carried_out()

    def resumed(self, monitor: str) -> None:
        """A monitor holds its topics no longer."""
        for names in self._held.values():
            names.pop(monitor, None)

    # --- a change ---

    def began(self, names: Iterable[str]) -> list[str]:
        """Those of these monitors that are in their initial state since the last change, moved ones among them."""
        return [name for name in names if name in self._began]

    async def take(self, coming: Revision) -> list[str]:
        """Have every relay take these; the monitors that began anew because they moved.

        Relays that are away are told when they are there. Raises `SpecificationsRefusedError`: nothing has changed.
        """
        plan = self.allocation.plan(coming.checked, self.relays.carried_now())
        self._began = set()
        for _ in range(_TRIES):
            await self._try(coming, plan)
            tried, plan = plan, self.allocation.plan(coming.checked, self.relays.carried_now())
            if plan == tried:
                return self._settle(coming, plan)
            for relay in plan.losing - tried.losing:
                self.relays.send(self._statement(self._now, relay, self.allocation.of_file), relay)
        self._restate()
        raise SpecificationsRefusedError(["topics that would have to move come and go meanwhile; try again"])

    async def all_taken(self) -> None:
        """Wait until the relays that gave something up have what is in force, or one of them fails to (`refused`)."""
        answers, self._answers = self._answers, {}
        if answers:
            await asyncio.wait(answers.values(), timeout=_RELAY_SECONDS)
        for relay, answer in answers.items():
            if not answer.done():
                self._refusals[relay] = [_SILENT]
                self._stop_waiting(relay)

    async def _try(self, coming: Revision, plan: Plan) -> None:
        await self._make(coming, _of(plan))
        take_effect()  # relays that give nothing up go on with what they are told now
        answers: dict[int, asyncio.Future[list[str]]] = {}
        self._coming = (coming, plan)
        for relay in range(self.allocation.relays):
            if relay in plan.losing:
                continue  # it goes on with what it has until its topics are withdrawn
            statement = self._statement(coming, relay, _of(plan), plan.moved_files)
            self._ask(relay, statement, answers)
        try:
            findings = await self._findings(list(answers.values()))
        finally:
            self._coming = None
            for relay in answers:
                self._stop_waiting(relay)
        if findings:
            self._restate()
            raise SpecificationsRefusedError(findings)

    def _ask(
        self,
        relay: int,
        statement: messages.SpecificationsStated,
        answers: dict[int, asyncio.Future[list[str]]],
    ) -> None:
        """Tell a relay, and have its answer among these if it is there."""
        if self.relays.send(statement, relay):
            answers[relay] = asyncio.get_running_loop().create_future()
            self._waiting[relay, statement.statement] = answers[relay]

    async def _findings(self, answers: list[asyncio.Future[list[str]]]) -> list[str]:
        try:
            said = await asyncio.wait_for(asyncio.gather(*answers), _RELAY_SECONDS)
        except TimeoutError:
            return [f"{_SILENT}; try again"]
        return [finding for findings in said for finding in findings]

    def _settle(self, coming: Revision, plan: Plan) -> list[str]:
        """Between two messages of every relay's link: nothing is awaited here.

        Those that have it already say so again.
        """
        self._now = coming
        self.relays.withdraw(plan.moves)
        self.allocation.adopt(plan)
        self._forget()
        for relay in range(self.allocation.relays):
            statement = self._statement(coming, relay, self.allocation.of_file, plan.moved_files)
            if relay in plan.losing:
                self._ask(relay, statement, self._answers)
            else:
                self.relays.send(statement, relay)
        self.relays.place(plan.moves)  # nothing to one that has just been asked: the plan goes one way
        self._merge_rows()
        moved = [name for name, file in coming.checked.monitors.items() if file in plan.moved_files]
        if plan.moves:
            self._say_moved(plan, moved)
        return moved

    def _merge_rows(self) -> None:
        """State and counters of the monitors, each as the relay tells it that has the monitor."""
        self.rows = {
            row.name: row
            for relay, rows in self._rows.items()
            for row in rows
            if self.allocation.of_file(row.file) == relay
        }

    def _say_moved(self, plan: Plan, monitors: list[str]) -> None:
        names = [move.name for move in plan.moves]
        anew = f"; {', '.join(monitors)} began in the initial state there" if monitors else ""
        self.trail.happened(
            "topics moved",
            f"{', '.join(names[:20])} {'are' if len(names) > 1 else 'is'} carried by another relay process{anew}",
            severity=Severity.ALARM if monitors else Severity.NOTICE,
            category="monitor",
            resource="",
            topics=names[:1000],
            monitors=monitors,
        )

    def _restate(self) -> None:
        self._forget()
        for relay in range(self.allocation.relays):
            self.relays.send(self._statement(self._now, relay, self.allocation.of_file), relay)

    async def _make(self, revision: Revision, of_file: Callable[[str], int]) -> None:
        """Have the compiler make what the relays run of these, as far as it is not there."""
        compiled = revision.checked.compiled
        wanted = {_names(revision, relay, of_file) for relay in range(self.allocation.relays)}
        missing = [names for names in wanted if names.monitors and (compiled, names) not in self._parts]
        made = await self.parts(compiled, missing) if missing else []
        for names, part in zip(missing, made, strict=True):
            self._parts[compiled, names] = part

    def _forget(self) -> None:
        """Keep what the relays run of what is in force."""
        compiled, relays = self._now.checked.compiled, range(self.allocation.relays)
        names = [_names(self._now, relay, self.allocation.of_file) for relay in relays]
        self._parts = {
            key: part for key, part in self._parts.items() if key[0] == compiled and key[1] in names
        }

    def _statement(
        self,
        revision: Revision,
        relay: int,
        of_file: Callable[[str], int],
        moved: frozenset[str] = frozenset(),
        *,
        restarted: bool = False,
        ahead: bool = False,
    ) -> messages.SpecificationsStated:
        states, files = self.states(revision.checked), revision.checked.monitors
        names = _names(revision, relay, of_file)
        return messages.SpecificationsStated(
            revision.number,
            self._parts[revision.checked.compiled, names] if names.monitors else b"",
            {name: states[name] is not False for name in names.monitors},
            restarted,
            self.on_fault,
            tuple(name for name in names.monitors if files[name] in moved),
            next(self._numbers),
            ahead,
            names.trials,
            self.slices,
        )

    # --- what the relays say ---

    def received(self, message: messages.Message, relay: int) -> None:
        """A message of a relay about its monitors."""
        match message:
            case messages.SpecificationsTaken():
                self._taken(relay, message)
            case messages.SpecificationsRefused(number, findings, statement):
                self._refused(relay, number, findings, statement)
            case messages.MonitorsCounted(rows):
                self._rows[relay] = rows
                self._merge_rows()

    def lost(self, relay: int) -> None:
        """A relay is gone: what it has not answered is refused, since it may have died of it."""
        for at, statement in [entry for entry in self._waiting if entry[0] == relay]:
            self._answer(at, statement, ["a relay process ended while it took them: try again"])

    def _taken(self, relay: int, taken: messages.SpecificationsTaken) -> None:
        statement, began, held = taken.statement, taken.began, taken.held
        self._refusals.pop(relay, None)
        self._say_held(relay, taken)
        self._held[relay] = {name: taken.because.get(name, "") for name in held}
        if (relay, statement) in self._waiting:
            self._began |= set(began)
        if relay in self._fresh and (began or held):
            parts = [f"{', '.join(began)} began in the initial state"] if began else []
            parts += [f"{', '.join(held)} hold their topics until resumed"] if held else []
            self.trail.happened(
                "monitors restarted",
                f"a new relay process: {'; '.join(parts)}",
                category="monitor",
                resource="",
                monitors=began,
                held=held,
            )
        self._fresh.discard(relay)
        self._answer(relay, statement, [])

    def _say_held(self, relay: int, taken: messages.SpecificationsTaken) -> None:
        """Record those that hold their topics from now on because their state is lost, and what lets them go on."""
        before = self._held.get(relay, {})
        for name, why in taken.because.items():
            if before.get(name) != why:
                self.trail.happened(
                    "topics held",
                    f"{name} holds its topics: {why}; when it is safe: rosrv monitor resume {name}",
                    severity=Severity.ALARM,
                    category="monitor",
                    resource="",
                    monitor=name,
                )

    def _refused(self, relay: int, number: int, findings: list[str], statement: int) -> None:
        if number == self._now.number:
            self._refusals[relay] = findings
        self.trail.happened(
            "specifications refused",
            f"the relay does not take revision {number}: {findings[0] if findings else ''}",
            severity=Severity.ALARM,
            findings=findings,
        )
        self._answer(relay, statement, findings or ["the relay gives no reason"])

    def _stop_waiting(self, relay: int) -> None:
        for entry in [entry for entry in self._waiting if entry[0] == relay]:
            del self._waiting[entry]

    def _answer(self, relay: int, statement: int, findings: list[str]) -> None:
        waiting = self._waiting.pop((relay, statement), None)
        if waiting is not None and not waiting.done():
            waiting.set_result(findings)


def _names(revision: Revision, relay: int, of_file: Callable[[str], int]) -> messages.PartNames:
    """The monitors that a relay has."""
    mine = tuple(name for name, file in revision.checked.monitors.items() if of_file(file) == relay)
    return messages.PartNames(mine, tuple(name for name in mine if name in revision.trials))


def _of(plan: Plan) -> Callable[[str], int]:
    return lambda file: plan.files.get(file, 0)
