"""Serve bundles to robots and advance their rollouts, from a state in memory that the database refreshes.

While the database is unreachable, robots get the last known selections, and no rollout advances. Time in which the
collector or the database was down counts neither as silence nor as health of robots.
"""

import asyncio
import datetime
import enum
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
import structlog
from tuf.api.metadata import Metadata

from appliance.base import clock
from appliance.formats.bundle_api import RobotReport
from appliance.formats.terms import BundlePath, Terms, TermsError
from rosrv_fleet.bundles.publication import (
    PublicationError,
    PublishedBundles,
    next_timestamp,
    read_publication,
)
from rosrv_fleet.bundles.repository import KeyFileError, load_online_key
from rosrv_fleet.enrolment import EnrolmentError, RobotGroup
from rosrv_fleet.failures import failure_of
from rosrv_fleet.rollouts import machine
from rosrv_fleet.rollouts.machine import (
    BundleRollout,
    HealthGates,
    OperatorAct,
    RobotSeen,
    target,
    unhealthy,
)
from rosrv_fleet.rollouts.store import RolloutStore, StoredReport, StoredRollout

# Determine whether each robot of a group has the bundle that it should have. No I/O.


class ConditionKind(enum.StrEnum):
    """The conditions of a robot, most severe first."""

    UNHEALTHY = "unhealthy"
    SILENT = "silent"
    NEVER_SEEN = "never seen"
    BEHIND = "behind"
    IN_FORCE = "in force"
    NO_BUNDLE = "no bundle"
    OFF = "off"


class RobotCondition(NamedTuple):
    """A robot's condition, with the reason if it needs one."""

    kind: ConditionKind
    why: str = ""


def conditions(
    rollout: BundleRollout | None, robots: Mapping[str, RobotSeen], now: float, off: Collection[str] = ()
) -> dict[str, RobotCondition]:
    """Return the condition of each robot. `rollout` is the group's last one; `off` robots are switched off.

    After a revert, reports about the reverted bundle no longer count.
    """
    sick = {} if rollout is None or rollout.state == "reverted" else unhealthy(rollout, robots, now)
    silent = (HealthGates() if rollout is None else rollout.gates).silent_seconds
    found = {}
    for robot, seen in robots.items():
        wanted = "" if rollout is None else target(rollout, robot, seen)
        if not seen.seen:
            found[robot] = RobotCondition(ConditionKind.NEVER_SEEN, "it never reported")
        elif now - seen.seen > silent and robot in off:
            found[robot] = RobotCondition(ConditionKind.OFF, "it was shut down cleanly")
        elif now - seen.seen > silent:
            found[robot] = RobotCondition(ConditionKind.SILENT, f"no report for {now - seen.seen:.0f} s")
        elif robot in sick:
            found[robot] = RobotCondition(ConditionKind.UNHEALTHY, sick[robot])
        elif wanted and seen.refused == wanted:
            found[robot] = RobotCondition(ConditionKind.UNHEALTHY, f"refused: {seen.reason[:200]}")
        elif wanted and seen.in_force != wanted:
            found[robot] = RobotCondition(ConditionKind.BEHIND, seen.trouble[:200] or f"{wanted} is selected")
        else:
            found[robot] = _condition(seen)
    return found


def _condition(seen: RobotSeen) -> RobotCondition:
    if not seen.in_force:
        return RobotCondition(ConditionKind.NO_BUNDLE)
    return RobotCondition(
        ConditionKind.IN_FORCE, "changed by an operator on the robot" if seen.changed else ""
    )


# Publish the operator's signed bundles, with a timestamp that the collector renews.

_Stamp = tuple[tuple[str, int, int], ...]


class BundlePublisher:
    """The publication in a folder, and its newest timestamp; `trouble` is the reason why robots take nothing new.

    `key` is the file of the timestamp's key.
    """

    def __init__(self, folder: Path, key: Path, store: RolloutStore, clock: Callable[[], float]) -> None:
        self.folder = folder
        self._key = key
        self._store = store
        self._clock = clock
        self._stamp: _Stamp | None = None
        self.publication: PublishedBundles | None = None
        self.timestamp: bytes | None = None
        self.trouble = "the publication is not read yet"

    @property
    def bundles(self) -> Mapping[str, Terms]:
        return {} if self.publication is None else self.publication.bundles

    @property
    def expires(self) -> float | None:
        """Return when the first signed metadata expire, in seconds since the epoch."""
        return None if self.publication is None else self.publication.expires.timestamp()

    async def renew(self) -> None:
        """Read the publication if it has changed, and renew the timestamp before it expires."""
        try:
            stamp = await asyncio.to_thread(_stamp, self.folder)
            if stamp != self._stamp or self.publication is None:
                self.publication = await asyncio.to_thread(read_publication, self.folder)
                self._stamp = stamp
            last = await asyncio.to_thread(self._store.timestamp)
            now = datetime.datetime.fromtimestamp(self._clock(), datetime.UTC)
            made = next_timestamp(self.publication, last, load_online_key(self._key), now)
        except (PublicationError, KeyFileError, OSError) as error:
            if self.trouble != str(error):
                _log.error("bundles cannot be published", reason=str(error))
            self.trouble = str(error)
            return
        if made is not None:
            await asyncio.to_thread(
                self._store.save_timestamp, Metadata.from_bytes(made).signed.version, made
            )
            last = await asyncio.to_thread(self._store.timestamp)
        self.timestamp, self.trouble = last, ""
        if self.publication.expires <= now:
            self.trouble = (
                f"the signed metadata expired at {self.publication.expires:%Y-%m-%d %H:%M} UTC, so robots take nothing:"
                " rosrv-fleet bundle sign, then bundle publish"
            )


def _stamp(folder: Path) -> _Stamp:
    found = (
        (path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in (folder / "metadata").iterdir()
    )
    return tuple(sorted(found))


_log = structlog.get_logger()
_TICK_SECONDS = 1.0
_PAUSE_SECONDS = 5.0  # after a failure
_DEAF_SECONDS = 60.0  # robots report every 30 s
_CLOCK_SECONDS = 60.0  # by which the clocks of the operator and the collector may differ
_MAX_COUNTED = 1_000_000_000
_MAX_ATTEMPTS = 10  # to apply an operator's order to a rollout that ticks change at the same time


Members = Callable[[], Mapping[str, RobotGroup]]
"""Returns the group of each enrolled robot that has one, or raises `OSError`."""


class RolloutRefusedError(Exception):
    """An operator's order or a robot's report about a rollout is rejected."""


@dataclass(eq=False)
class SelectionListener:
    """An open event stream. `changed` is set when the robot's selection differs from `last`."""

    robot: str
    group: RobotGroup
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    last: str | None = None


class BundleService:
    """The published bundles and their rollouts. Orders raise `RolloutRefusedError`.

    `folder` has the operator's publication; `key` is the file of the timestamp's key. `off` returns the robots that
    were shut down cleanly.
    """

    def __init__(
        self,
        folder: Path,
        key: Path,
        store: RolloutStore,
        members: Members,
        clock: Callable[[], float] = clock.wall,
        *,
        off: Callable[[], Collection[str]] = frozenset,
    ) -> None:
        self.store = store
        self.publisher = BundlePublisher(folder, key, store, clock)
        self._members = members
        self._clock = clock
        self._off = off
        self._ticked = 0.0  # the time of the last tick that reached the database
        self._deaf = (0.0, 0.0)  # the beginning of the last time in which no robot was heard, and its seconds
        self.robots: dict[RobotGroup, dict[str, RobotSeen]] = {}
        self.rollouts: dict[RobotGroup, StoredRollout] = {}
        self._ticking = asyncio.Lock()
        self._arrived: dict[str, StoredReport] = {}  # stored since the last tick began to read them
        self.listeners: set[SelectionListener] = set()
        self.stopping = False

    async def run(self) -> None:
        while True:
            try:
                await self.tick()
            except Exception as error:  # noqa: BLE001  after any failure, rollouts advance later
                _log.error("no rollout advances", reason=failure_of(error))
                await asyncio.sleep(_PAUSE_SECONDS)
            await asyncio.sleep(_TICK_SECONDS)

    async def tick(self) -> None:
        """Publish, read the reports and rollouts, and advance.

        Ticks exclude each other: an older one would otherwise overwrite the state that a newer one has read.
        """
        async with self._ticking:
            await self.publisher.renew()
            members = await asyncio.to_thread(self._members)
            self._arrived.clear()
            reports = await asyncio.to_thread(self.store.reports)
            reports |= await self._rewind_reports(reports)
            self.robots = _by_group(members, reports | self._arrived)
            self.rollouts = await asyncio.to_thread(self.store.latest)
            await self._rewind_rollouts()
            await self._resume(reports)
            await self._advance()
            self._wake()

    @property
    def advancing(self) -> bool:
        return self._clock() - self._ticked < _DEAF_SECONDS

    # --- robots ---

    def selection(self, robot: str, group: RobotGroup) -> str:
        """Return the bundle that a robot should have, or "" without a signed one."""
        stored = self.rollouts.get(group)
        if stored is None:
            return ""
        chosen = machine.target(stored.rollout, robot, self.robots.get(group, {}).get(robot))
        return chosen if chosen in self.publisher.bundles else ""

    async def report(self, robot: str, group: RobotGroup, report: RobotReport) -> None:
        seen = _check(report, self._clock())
        await asyncio.to_thread(self.store.save_report, robot, group, seen)
        self._arrived[robot] = StoredReport(group, seen)
        if robot in self.robots.get(group, {}):
            self.robots[group][robot] = seen

    def group(self, site: str, group: str) -> RobotGroup:
        try:
            return RobotGroup.parse(f"{site}/{group}")
        except EnrolmentError as error:
            raise RolloutRefusedError(str(error)) from error

    def listen(self, robot: str, group: RobotGroup) -> SelectionListener:
        """Return a listener. It is already set if the robot may have missed an event, or if the collector stops."""
        listener = SelectionListener(robot, group, last=self.selection(robot, group))
        seen = self.robots.get(group, {}).get(robot)
        behind = listener.last and (seen is None or seen.in_force != listener.last)
        if behind or self.stopping:
            listener.changed.set()
        self.listeners.add(listener)
        return listener

    def unlisten(self, listener: SelectionListener) -> None:
        self.listeners.discard(listener)

    def end_streams(self) -> None:
        self.stopping = True
        for listener in self.listeners:
            listener.changed.set()

    # --- orders ---

    async def start(self, path: BundlePath, gates: HealthGates, who: str) -> StoredRollout:
        group = self.group(path.site, path.group)
        terms = self.publisher.bundles.get(str(path))
        if terms is None:
            signed = [
                name for name in self.publisher.bundles if name.startswith(f"{path.site}/{path.group}/")
            ]
            raise RolloutRefusedError(f"{path} is not published; there are: {', '.join(signed) or 'none'}")
        last = (await asyncio.to_thread(self.store.latest)).get(group)
        before = "" if last is None else _in_force_after(last.rollout)
        if before == str(path):
            raise RolloutRefusedError(f"{path} is in force already")
        now = self._clock()
        if terms.signed - now > _CLOCK_SECONDS:
            raise RolloutRefusedError(
                f"{path} was signed {terms.signed - now:.0f} s in the future: correct the clock of the collector, or"
                " that of the machine that signs, and add the bundle again"
            )
        kept = set() if last is None else machine.kept_after(last.rollout)
        rollout = BundleRollout(
            str(path),
            before,
            terms,
            gates,
            now,
            acts=[OperatorAct(now, who, "start")],
            kept=sorted(kept.intersection(self.publisher.bundles)),
        )
        members = await asyncio.to_thread(self._members)
        fault = machine.fault_of_rings(rollout, {one for one, own in members.items() if own == group})
        if fault:
            raise RolloutRefusedError(fault)
        number = await asyncio.to_thread(self.store.begin, group, last, rollout, now)
        if number is None:
            raise RolloutRefusedError(f"a rollout of {path.site}/{path.group} is running: stop it first")
        await self.tick()
        return self.rollouts[group]

    async def stop(self, group: RobotGroup, who: str, number: int | None = None) -> StoredRollout:
        def stop(rollout: BundleRollout) -> BundleRollout:
            return self._by(machine.stop(rollout, f"stopped by {who}"), rollout, who, "stop")

        return await self._change(group, stop, number)

    async def revert(self, group: RobotGroup, who: str, number: int | None = None) -> StoredRollout:
        """Give all robots the bundle from before the last rollout, or from before `number` if that is the last."""

        def back(rollout: BundleRollout) -> BundleRollout:
            if not rollout.before:
                raise RolloutRefusedError(
                    "there was no bundle before: add one with the former content, and roll it out"
                )
            if rollout.before not in self.publisher.bundles:
                raise RolloutRefusedError(
                    f"{rollout.before} is withdrawn: add a bundle with its content, and roll that out"
                )
            return self._by(machine.revert(rollout, f"reverted by {who}"), rollout, who, "revert")

        return await self._change(group, back, number)

    def counts(self, group: RobotGroup) -> list[dict[str, object]]:
        stored = self.rollouts.get(group)
        return [] if stored is None else machine.counts(stored.rollout, self._heard(group), self._clock())

    def conditions(self, group: RobotGroup) -> dict[str, RobotCondition]:
        stored = self.rollouts.get(group)
        rollout = None if stored is None else stored.rollout
        return conditions(rollout, self._heard(group), self._clock(), self._off())

    # --- inside ---

    def _by(
        self, changed: BundleRollout, before: BundleRollout, who: str, act: Literal["stop", "revert"]
    ) -> BundleRollout:
        if changed == before:
            return before
        return msgspec.structs.replace(changed, acts=[*before.acts, OperatorAct(self._clock(), who, act)])

    def _heard(self, group: RobotGroup) -> dict[str, RobotSeen]:
        """Return the robots' reports, without counting the time in which the collector heard none of them."""
        since, seconds = self._deaf
        return {
            robot: msgspec.structs.replace(seen, seen=seen.seen + seconds) if 0 < seen.seen <= since else seen
            for robot, seen in self.robots.get(group, {}).items()
        }

    async def _rewind_reports(self, reports: Mapping[str, StoredReport]) -> dict[str, StoredReport]:
        """Date reports from the future now, and return them: the clock was ahead, and has been corrected."""
        now = self._clock()
        if sum(self._deaf) > now + _CLOCK_SECONDS:
            self._deaf = (0.0, 0.0)
        rewound = {
            robot: report._replace(seen=msgspec.structs.replace(report.seen, seen=now))
            for robot, report in reports.items()
            if report.seen.seen > now + _CLOCK_SECONDS
        }
        for robot, (group, seen) in rewound.items():
            if robot not in self._arrived:
                await asyncio.to_thread(self.store.save_report, robot, group, seen)
        return rewound

    async def _rewind_rollouts(self) -> None:
        now = self._clock()
        for group, stored in list(self.rollouts.items()):
            rollout = stored.rollout
            if max(rollout.started, rollout.opened, rollout.healthy or 0.0) > now + _CLOCK_SECONDS:
                await self._save(group, stored, machine.rewound(rollout, now), now)

    async def _resume(self, reports: Mapping[str, StoredReport]) -> None:
        now = self._clock()
        heard = max([self._ticked, *(report.seen.seen for report in reports.values())])
        self._ticked = now
        if not heard or now - heard <= _DEAF_SECONDS:
            return
        self._deaf = (heard, now - heard)
        _log.warning("no robot was heard, because the collector was away", seconds=round(now - heard))
        for group, stored in list(self.rollouts.items()):
            await self._save(group, stored, machine.resume(stored.rollout, now - heard), now)

    async def _change(
        self, group: RobotGroup, change: Callable[[BundleRollout], BundleRollout], number: int | None
    ) -> StoredRollout:
        """Apply an operator's change to the last rollout.

        Try again if a tick has changed the rollout in between, but not if another operator has.
        """
        acts: list[OperatorAct] | None = None
        for _attempt in range(_MAX_ATTEMPTS):
            stored = (await asyncio.to_thread(self.store.latest)).get(group)
            if stored is None:
                raise RolloutRefusedError(f"there was no rollout of {group}")
            number = stored.number if number is None else number
            acts = stored.rollout.acts if acts is None else acts
            if (stored.number, stored.rollout.acts) != (number, acts):
                break
            changed = change(stored.rollout)
            if changed == stored.rollout or await asyncio.to_thread(
                self.store.replace, group, stored, changed, self._clock()
            ):
                await self.tick()
                return self.rollouts[group]
        raise RolloutRefusedError("the rollout has changed in the meantime: look at it, and try again")

    async def _advance(self) -> None:
        now = self._clock()
        for group, stored in list(self.rollouts.items()):
            published = self.publisher.publication
            if published is not None and stored.rollout.path not in published.bundles:
                rollout = machine.stop(stored.rollout, f"{stored.rollout.path} was withdrawn")
            else:
                rollout = machine.advance(stored.rollout, self._heard(group), now)
            await self._save(group, stored, rollout, now)

    async def _save(
        self, group: RobotGroup, stored: StoredRollout, rollout: BundleRollout, now: float
    ) -> None:
        if rollout == stored.rollout or not await asyncio.to_thread(
            self.store.replace, group, stored, rollout, now
        ):
            return
        self.rollouts[group] = StoredRollout(stored.number, rollout)
        if (rollout.state, rollout.ring) != (stored.rollout.state, stored.rollout.ring):
            _log.warning("a rollout has changed", bundle=rollout.path, state=rollout.state, why=rollout.why)

    def _wake(self) -> None:
        for listener in self.listeners:
            selection = self.selection(listener.robot, listener.group)
            if selection != listener.last:
                listener.last = selection
                listener.changed.set()


def _by_group(
    members: Mapping[str, RobotGroup], reports: Mapping[str, StoredReport]
) -> dict[RobotGroup, dict[str, RobotSeen]]:
    found: dict[RobotGroup, dict[str, RobotSeen]] = {}
    for name, group in sorted(members.items()):
        report = reports.get(name, StoredReport(group, RobotSeen()))
        found.setdefault(group, {})[name] = report.seen if report.group == group else RobotSeen()
    return found


def _check(report: RobotReport, now: float) -> RobotSeen:
    for path in filter(None, (report.in_force, report.trying, report.refused)):
        try:
            BundlePath.parse(path)
        except TermsError as error:
            raise RolloutRefusedError(f"a bundle of the report is invalid: {error}") from error
    if not (0 <= report.denials <= _MAX_COUNTED and 0 <= report.failing <= _MAX_COUNTED):
        raise RolloutRefusedError(f"a number of the report is not between 0 and {_MAX_COUNTED}")
    fields = msgspec.structs.asdict(report)
    del fields["site"], fields["group"]
    # PostgreSQL stores no NUL in a text.
    fields |= {
        name: fields[name].replace("\0", "\N{REPLACEMENT CHARACTER}") for name in ("reason", "trouble")
    }
    return RobotSeen(now, **fields)


def _in_force_after(rollout: BundleRollout) -> str:
    return rollout.path if rollout.state == "done" else rollout.before
