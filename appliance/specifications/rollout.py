"""Roll out new specifications to all relays, each with its own files, or to none.

First, relays that give nothing up get their new specifications. Then moving topics are withdrawn, the allocation
changes, and the topics are placed on the relay that has their monitors, so no message bypasses its monitors.
Finally the other relays get their specifications (`all_taken`). A monitor whose file moves loses its state; if
its actions depend on that, it holds its topics.
"""

import asyncio
import itertools
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.base.withdrawal import WithdrawnError, take_effect
from appliance.channel import messages
from appliance.channel.messages import Message
from appliance.specifications.allocation import Allocation, AllocationPlan, Move, Resource
from appliance.specifications.in_force import InForce
from appliance.specifications.specification_files import CheckedSpecifications, SpecificationsRefusedError
from appliance.telemetry.audit_trail import AuditTrail

_RELAY_SECONDS = 15.0
_TRIES = 5  # attempts, because affected nodes may come and go during each
_SILENT = f"a relay does not answer within {_RELAY_SECONDS:g} s"


class Relays(Protocol):
    def send(self, message: Message, relay: int) -> bool:
        """Send a message; return False if the relay is not connected."""

    async def carried_out(self) -> None:
        """Wait until every relay has carried out its messages."""

    def live_resources(self) -> set[Resource]: ...

    def withdraw(self, moves: Sequence[Move]) -> None:
        """Withdraw moving topics, before the new allocation is adopted."""

    def place(self, moves: Sequence[Move]) -> None:
        """Place moved topics, after the new allocation was adopted."""


@dataclass(frozen=True, slots=True)
class InheritedState:
    """The states that the other appliance's relays `left`, and why others are `lost`.

    `at` is the time of its monitors then, if it is later than the time in the states.
    """

    lost: str = ""
    left: tuple[bytes, ...] = ()
    at: int = 0


Parts = Callable[[bytes, list[messages.PartNames]], Awaitable[list[bytes]]]
"""Returns the parts of relays. Raises `SpecificationsRefusedError`."""


@dataclass(slots=True)
class Rollout:
    """The specifications on all relays. Each gets only its own part, which `parts` makes."""

    allocation: Allocation
    trail: AuditTrail
    on_fault: Literal["drop", "pass"]
    relays: Relays
    slices: int
    parts: Parts
    rows: dict[str, messages.MonitorRow] = field(default_factory=dict)
    unfit: dict[int, str] = field(default_factory=dict)
    """Why the part of a relay in the heartbeat is off, or an empty text; without a relay that has not reported."""
    acting: dict[int, int] = field(default_factory=dict)
    """The monitors in force of each relay that may stop, change or withhold messages."""
    _now: InForce = field(default_factory=InForce)
    # The relays' parts of the specifications in force, and of specifications being tried.
    compiled_parts: dict[tuple[bytes, messages.PartNames], bytes] = field(default_factory=dict)
    _known: set[int] = field(default_factory=set)  # relays that have had specifications
    _fresh: set[int] = field(default_factory=set)  # relays that have not answered since they connected
    _coming: tuple[InForce, AllocationPlan] | None = None  # the specifications being tried
    # Answers awaited from relays that gave something up.
    _answers: dict[int, asyncio.Future[list[str]]] = field(default_factory=dict)
    # Answers by relay and statement.
    _waiting: dict[tuple[int, int], asyncio.Future[list[str]]] = field(default_factory=dict)
    # Relays may outlive control, so no number may be repeated.
    _numbers: Iterator[int] = field(default_factory=lambda: itertools.count(clock.now_ns()))
    _refusals: dict[int, list[str]] = field(default_factory=dict)
    _began: set[str] = field(default_factory=set)  # monitors that began again by the present change
    _held: dict[int, dict[str, str]] = field(default_factory=dict)
    _inherited: InheritedState = field(default_factory=InheritedState)
    _heirs: set[int] = field(default_factory=set)  # relays that have not taken the inherited state yet
    _left: dict[tuple[int, int], asyncio.Future[messages.StateLeft]] = field(default_factory=dict)
    _leaving: bool = False  # whether the relays drop all messages, because this appliance hands over
    _inheritance_taken: Callable[[], None] = lambda: None
    _rows: dict[int, list[messages.MonitorRow]] = field(default_factory=dict)

    @property
    def refused(self) -> list[str]:
        return [finding for findings in self._refusals.values() for finding in findings]

    @property
    def held(self) -> set[str]:
        return set(self.why_held)

    @property
    def why_held(self) -> dict[str, str]:
        return {name: why for names in self._held.values() for name, why in names.items()}

    async def start(self, now: InForce, *, restarted: bool, kept: str) -> None:
        """Begin with these specifications; after a crash of control (`restarted`), relays keep theirs."""
        self._now = now
        if restarted:
            self._known = set(range(self.allocation.relays))
        carried = self.allocation.resources if restarted and self.allocation.restore(kept) else ()
        # control may have died during a change after storing its allocation: adapt the allocation as little as possible
        self.allocation.adopt(self.allocation.plan(now.checked, carried))
        await self._make(now, self.allocation.of_file)

    def adopt(self, now: InForce) -> None:
        """Let later statements be of this value; the relays have it, or get the difference in messages of its own."""
        self._now = now
        self._forget()

    async def take_back(self, earlier: InForce) -> None:
        """Return all relays to the specifications that they had before `take`, and which they do not refuse.

        Each gets the same part again, because the compiler may fail now.
        """
        self._settle(earlier, self.allocation.plan_back(earlier.checked, self.relays.live_resources()))
        await self.all_taken()

    async def leave(self, seconds: float) -> list[bytes]:
        """Make all relays drop all messages. Raises `ConnectionError`, `TimeoutError`."""
        self._leaving = True
        return [answer.content or b"" for answer in await self._states(seconds, copy=False)]

    async def copies(self, seconds: float, *, full: bool) -> list[messages.StateLeft]:
        """Return the states that have changed, or (`full`) all. Raises as `leave` does."""
        return await self._states(seconds, copy=True, full=full)

    async def _states(self, seconds: float, *, copy: bool, full: bool = True) -> list[messages.StateLeft]:
        loop, self._left = asyncio.get_running_loop(), {}
        for relay in range(self.allocation.relays):
            wanted = messages.StateWanted(next(self._numbers), copy, full)
            if not self.relays.send(wanted, relay):
                raise ConnectionError("a relay is being restarted")
            self._left[relay, wanted.number] = loop.create_future()
        async with asyncio.timeout(seconds):
            return [await answer for answer in [*self._left.values()]]

    def pass_again(self) -> None:
        self._leaving = False
        for relay in range(self.allocation.relays):
            self.relays.send(self.statement(relay), relay)

    def has_state(self) -> bool:
        """Return whether the state may be copied: no relay leaves it, and all have the inherited one."""
        return bool(self._now.checked.monitors) and not self._leaving and not self._heirs

    def inherit(self, state: InheritedState, taken: Callable[[], None]) -> None:
        self._inherited, self._heirs = state, set(range(self.allocation.relays))
        self._inheritance_taken = taken

    def statement(self, relay: int) -> messages.SpecificationsStated:
        """Return the specifications for a relay; a restarted relay must hold topics as its monitors require."""
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
        return self.allocation.of_file(self._now.checked.monitors[monitor])

    def tell(self, monitor: str, message: messages.Message) -> bool:
        return self.relays.send(message, self.relay_of(monitor))

    async def carried_out(self) -> None:
        await self.relays.carried_out()

    def resumed(self, monitor: str) -> None:
        for names in self._held.values():
            names.pop(monitor, None)

    # --- a change ---

    def began(self, names: Iterable[str]) -> list[str]:
        return [name for name in names if name in self._began]

    async def take(self, coming: InForce) -> list[str]:
        """Roll out specifications; return the monitors that began again because they moved.

        After a `SpecificationsRefusedError`, nothing has changed.
        """
        before, plan = self._now, self.allocation.plan(coming.checked, self.relays.live_resources())
        await self._make(coming, _of(plan))
        try:
            take_effect()  # from here on, relays that give nothing up use the new specifications
        except WithdrawnError:
            self._forget()
            raise
        self._began = set()
        try:
            for _ in range(_TRIES):
                await self._try(coming, plan)
                shadowed, plan = plan, self.allocation.plan(coming.checked, self.relays.live_resources())
                if plan == shadowed:
                    return self._settle(coming, plan)
                for relay in plan.losing - shadowed.losing:
                    self.relays.send(self._statement(self._now, relay, self.allocation.of_file), relay)
                await self._make(coming, _of(plan))
            raise SpecificationsRefusedError(["topics that must move changed during the rollout; try again"])
        except BaseException:
            self._forget()
            self._now = before
            for relay in range(self.allocation.relays):
                self.relays.send(self._statement(self._now, relay, self.allocation.of_file), relay)
            raise

    def moved_files(self, coming: CheckedSpecifications) -> frozenset[str]:
        return self.allocation.plan(coming, self.relays.live_resources()).moved_files

    async def all_taken(self) -> None:
        """Wait for the relays that gave something up; their refusals are in `refused`."""
        answers, self._answers = self._answers, {}
        if answers:
            await asyncio.wait(answers.values(), timeout=_RELAY_SECONDS)
        for relay, answer in answers.items():
            if not answer.done():
                self._refusals[relay] = [_SILENT]
                self._stop_waiting(relay)

    async def _try(self, coming: InForce, plan: AllocationPlan) -> None:
        answers: dict[int, asyncio.Future[list[str]]] = {}
        self._coming = (coming, plan)
        for relay in range(self.allocation.relays):
            if relay in plan.losing:
                continue  # this relay keeps its specifications until its topics are withdrawn
            statement = self._statement(coming, relay, _of(plan), plan.moved_files)
            self._ask(relay, statement, answers)
        try:
            findings = await self._findings(list(answers.values()))
        finally:
            self._coming = None
            for relay in answers:
                self._stop_waiting(relay)
        if findings:
            raise SpecificationsRefusedError(findings)

    def _ask(
        self,
        relay: int,
        statement: messages.SpecificationsStated,
        answers: dict[int, asyncio.Future[list[str]]],
    ) -> None:
        if self.relays.send(statement, relay):
            answers[relay] = asyncio.get_running_loop().create_future()
            self._waiting[relay, statement.statement] = answers[relay]

    async def _findings(self, answers: list[asyncio.Future[list[str]]]) -> list[str]:
        try:
            async with asyncio.timeout(_RELAY_SECONDS):
                said = await asyncio.gather(*answers)
        except TimeoutError:
            return [f"{_SILENT}; try again"]
        return [finding for findings in said for finding in findings]

    def _settle(self, coming: InForce, plan: AllocationPlan) -> list[str]:
        """Adopt a plan without `await`, so that no message of a relay is processed in between."""
        self._now = coming
        self.relays.withdraw(plan.moves)
        self.allocation.adopt(plan)
        for relay in range(self.allocation.relays):
            statement = self._statement(coming, relay, self.allocation.of_file, plan.moved_files)
            if relay in plan.losing:
                self._ask(relay, statement, self._answers)
            else:
                self.relays.send(statement, relay)
        self.relays.place(plan.moves)  # in a plan, no relay both loses and gains topics
        self._merge_rows()
        moved = [name for name, file in coming.checked.monitors.items() if file in plan.moved_files]
        if plan.moves:
            self._say_moved(plan, moved)
        return moved

    def _merge_rows(self) -> None:
        files = self._now.checked.monitors
        self.rows = {
            row.name: row
            for relay, rows in self._rows.items()
            for row in rows
            if self.allocation.of_file(files.get(row.name, row.file)) == relay
        }

    def _say_moved(self, plan: AllocationPlan, monitors: list[str]) -> None:
        names = [move.name for move in plan.moves]
        anew = f"; {', '.join(monitors)} started in the initial state there" if monitors else ""
        self.trail.happened(
            "topics moved",
            f"{', '.join(names[:20])} {'are' if len(names) > 1 else 'is'} handled by another relay process{anew}",
            severity=Severity.ALARM if monitors else Severity.NOTICE,
            category="monitor",
            resource="",
            topics=names[:1000],
            monitors=monitors,
        )

    async def _make(self, revision: InForce, of_file: Callable[[str], int]) -> None:
        compiled = revision.checked.compiled
        wanted = parts_wanted(revision, self.allocation.relays, of_file)
        missing = [names for names in wanted if (compiled, names) not in self.compiled_parts]
        made = await self.parts(compiled, missing) if missing else []
        for names, part in zip(missing, made, strict=True):
            self.compiled_parts[compiled, names] = part

    def _forget(self) -> None:
        compiled, relays = self._now.checked.compiled, range(self.allocation.relays)
        names = [_names(self._now, relay, self.allocation.of_file) for relay in relays]
        self.compiled_parts = {
            key: part for key, part in self.compiled_parts.items() if key[0] == compiled and key[1] in names
        }

    def _statement(
        self,
        revision: InForce,
        relay: int,
        of_file: Callable[[str], int],
        moved: frozenset[str] = frozenset(),
        *,
        restarted: bool = False,
        ahead: bool = False,
    ) -> messages.SpecificationsStated:
        states, files = revision.states, revision.checked.monitors
        inherited = self._inherited if relay in self._heirs else InheritedState()
        names, given = _names(revision, relay, of_file), revision.givens.in_force(revision.checked)
        return messages.SpecificationsStated(
            revision.number,
            self.compiled_parts[revision.checked.compiled, names] if names.monitors else b"",
            {name: states[name] is not False for name in names.monitors},
            restarted or bool(inherited.lost),
            self.on_fault,
            tuple(name for name in names.monitors if files[name] in moved),
            next(self._numbers),
            ahead,
            names.shadows,
            self.slices,
            inherited.lost,
            inherited.left,
            inherited.at,
            {name: why for name, why in revision.checked.unbuilt.items() if name in names.monitors},
            {name: values for name, values in given.items() if name in names.monitors},
            tuple(revision.checked.left_out),
        )

    # --- messages of the relays ---

    def received(self, message: messages.Message, relay: int) -> None:
        match message:
            case messages.SpecificationsTaken():
                self._taken(relay, message)
            case messages.StateLeft(number) if (relay, number) in self._left:
                self._left.pop((relay, number)).set_result(message)
            case messages.SpecificationsRefused(number, findings, statement):
                self._refused(relay, number, findings, statement)
            case messages.MonitorsCounted(rows, unfit, acting):
                self._rows[relay], self.unfit[relay], self.acting[relay] = rows, unfit, acting
                self._merge_rows()

    def lost(self, relay: int) -> None:
        """Answer for a relay that ended, perhaps because of specifications that it has not answered."""
        self.unfit[relay] = "a relay process ended"
        for at, statement in [entry for entry in self._waiting if entry[0] == relay]:
            self._answer(at, statement, ["a relay process exited during the load: try again"])

    def _taken(self, relay: int, taken: messages.SpecificationsTaken) -> None:
        statement, began, held = taken.statement, taken.began, taken.held
        if relay in self._heirs:
            self._heirs.discard(relay)
            if not self._heirs:
                self._inheritance_taken()
        self._refusals.pop(relay, None)
        self._say_held(relay, taken)
        self._held[relay] = {name: taken.because.get(name, "") for name in held}
        if (relay, statement) in self._waiting:
            self._began |= set(began)
        if relay in self._fresh and (began or held):
            parts = [f"{', '.join(began)} started in the initial state"] if began else []
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
        before = self._held.get(relay, {})
        checked = self._now.checked
        for name, why in taken.because.items():
            if before.get(name) != why:
                fix = f"when it is safe: rosrv monitor resume {name}"
                if name in checked.unbuilt:
                    fix = f"rosrv monitor load {checked.monitors[name]}"
                self.trail.happened(
                    "topics held",
                    f"{name} holds its topics: {why}; {fix}",
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
            f"the relay rejects revision {number}: {findings[0] if findings else ''}",
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


def _names(revision: InForce, relay: int, of_file: Callable[[str], int]) -> messages.PartNames:
    mine = tuple(name for name, file in revision.checked.monitors.items() if of_file(file) == relay)
    return messages.PartNames(mine, tuple(filter(revision.switches.in_shadow, mine)))


def parts_wanted(
    revision: InForce, relays: int, of_file: Callable[[str], int] | None = None
) -> list[messages.PartNames]:
    """Return the parts of all relays; without `of_file`, those of a start on another appliance."""
    if of_file is None:
        of_file = _of(Allocation(relays).plan(revision.checked))
    names = dict.fromkeys(_names(revision, relay, of_file) for relay in range(relays))
    return [name for name in names if name.monitors]


def _of(plan: AllocationPlan) -> Callable[[str], int]:
    return lambda file: plan.files.get(file, 0)
