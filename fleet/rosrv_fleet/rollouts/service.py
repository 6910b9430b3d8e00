"""Serve bundles to robots and advance their rollouts: the state in memory, refreshed from the database.

Robots' requests are answered from memory. `run` looks at the publication and the database once a second, advances the
running rollouts, and wakes robots whose selection has changed. While the database is unreachable, robots get the last
known selections, and no rollout advances.
"""

import asyncio
import datetime
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import structlog
from psycopg import Error as DatabaseError
from tuf.api.metadata import Metadata

from appliance.bundles.poller import RobotReport
from appliance.bundles.terms import ROBOT_NAME, BundlePath, TermsError, role_of
from rosrv_fleet.bundles.keys import KeyFileError, load_online_key
from rosrv_fleet.bundles.publication import Publication, PublicationError, next_timestamp, read_publication
from rosrv_fleet.rollouts import machine
from rosrv_fleet.rollouts.machine import HealthGates, RobotSeen, Rollout
from rosrv_fleet.rollouts.store import Group, RolloutStore, StoredRollout

_log = structlog.get_logger()
_TICK_SECONDS = 1.0
_PAUSE_SECONDS = 5.0  # after a failure of the database
_Stamp = tuple[tuple[str, int, int], ...]


class RolloutRefusedError(Exception):
    """An order about a rollout is refused; the text has the reason and what to do."""


@dataclass(eq=False)
class Listener:
    """A robot that listens for events: `changed` is set when its selection differs from the last one."""

    robot: str
    group: Group
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    last: str | None = None


class BundleService:
    """The collector's bundles. `folder` is what the operator publishes; `key` is the file of the timestamp's key."""

    def __init__(
        self, folder: Path, key: Path, store: RolloutStore, clock: Callable[[], float] = time.time
    ) -> None:
        self.folder = folder
        self.store = store
        self._key = key
        self._clock = clock
        self.publication: Publication | None = None
        self.trouble = "the publication is not read yet"
        self.timestamp: bytes | None = None
        self.robots: dict[Group, dict[str, RobotSeen]] = {}
        self.rollouts: dict[Group, StoredRollout] = {}
        self._stamp: _Stamp | None = None
        self.listeners: set[Listener] = set()
        self.stopping = False

    async def run(self) -> None:
        """Keep the state up to date until the task is cancelled."""
        while True:
            try:
                await self.tick()
            except DatabaseError as error:
                _log.error("the database is unreachable: no rollout advances", reason=str(error))
                await asyncio.sleep(_PAUSE_SECONDS)
            await asyncio.sleep(_TICK_SECONDS)

    async def tick(self) -> None:
        """Read the publication and the database, sign a due timestamp, advance rollouts, wake robots."""
        await self._publish()
        self.robots = await asyncio.to_thread(self.store.robots)
        self.rollouts = await asyncio.to_thread(self.store.latest)
        await self._advance()
        self._wake()

    # --- robots ---

    def selection(self, robot: str, group: Group) -> str:
        """Return the bundle that a robot should have; empty for none."""
        stored = self.rollouts.get(group)
        if stored is None:
            return ""
        return machine.selected(stored.rollout, robot, self.robots.get(group, {}).get(robot))

    async def report(self, robot: str, report: RobotReport) -> None:
        """Store what a robot reports about itself. Raises `RolloutRefusedError` for an invalid name."""
        group = self.group(report.site, report.group)
        if ROBOT_NAME.fullmatch(robot) is None:
            raise RolloutRefusedError(f"{robot[:80]!r} is not the name of a robot")
        fields = msgspec.structs.asdict(report)
        del fields["site"], fields["group"]
        seen = RobotSeen(self._clock(), **fields)
        self.robots.setdefault(group, {})[robot] = seen
        await asyncio.to_thread(self.store.save_report, robot, group, seen)

    def group(self, site: str, group: str) -> Group:
        """Return a group. Raises `RolloutRefusedError` for invalid names."""
        try:
            role_of(site, group)
        except TermsError as error:
            raise RolloutRefusedError(str(error)) from error
        return Group(site, group)

    def listen(self, robot: str, group: Group) -> Listener:
        """Return a listener for a robot; `unlisten` ends it.

        It is woken at once if the robot has not reported its selection in force: it may have missed an event.
        """
        listener = Listener(robot, group, last=self.selection(robot, group))
        seen = self.robots.get(group, {}).get(robot)
        if listener.last and (seen is None or seen.in_force != listener.last):
            listener.changed.set()
        self.listeners.add(listener)
        return listener

    def unlisten(self, listener: Listener) -> None:
        """Remove a listener."""
        self.listeners.discard(listener)

    def end_streams(self) -> None:
        """End the event streams of all robots, because the collector stops."""
        self.stopping = True
        for listener in self.listeners:
            listener.changed.set()

    # --- orders ---

    async def start(self, path: BundlePath, gates: HealthGates) -> StoredRollout:
        """Begin the rollout of a signed bundle. Raises `RolloutRefusedError`."""
        group = self.group(path.site, path.group)
        terms = None if self.publication is None else self.publication.bundles.get(str(path))
        if terms is None:
            signed = [name for name in self._signed() if name.startswith(f"{path.site}/{path.group}/")]
            raise RolloutRefusedError(f"{path} is not published; there are: {', '.join(signed) or 'none'}")
        last = (await asyncio.to_thread(self.store.latest)).get(group)
        before = "" if last is None else _in_force_after(last.rollout)
        if before == str(path):
            raise RolloutRefusedError(f"{path} is in force already")
        now = self._clock()
        rollout = Rollout(str(path), before, terms, gates, now)
        number = await asyncio.to_thread(self.store.begin, group, rollout, now)
        if number is None:
            raise RolloutRefusedError(f"a rollout of {path.site}/{path.group} runs: stop it first")
        await self.tick()
        return self.rollouts[group]

    async def stop(self, group: Group, who: str) -> StoredRollout:
        """Stop the running rollout of a group. Raises `RolloutRefusedError`."""
        return await self._change(group, lambda rollout: machine.stopped(rollout, f"stopped by {who}"))

    async def revert(self, group: Group, who: str) -> StoredRollout:
        """Give all robots of a group the bundle from before the last rollout. Raises `RolloutRefusedError`."""

        def back(rollout: Rollout) -> Rollout:
            if not rollout.before:
                raise RolloutRefusedError(
                    "there was no bundle before: add one with the former content, and roll it out"
                )
            if rollout.before not in self._signed():
                raise RolloutRefusedError(
                    f"{rollout.before} is withdrawn: add a bundle with its content, and roll that out"
                )
            return machine.reverted(rollout, f"reverted by {who}")

        return await self._change(group, back)

    def counts(self, group: Group) -> list[dict[str, object]]:
        """Return the rings of a group's last rollout with their robots."""
        stored = self.rollouts.get(group)
        return (
            []
            if stored is None
            else machine.counts(stored.rollout, self.robots.get(group, {}), self._clock())
        )

    # --- inside ---

    def _signed(self) -> Mapping[str, object]:
        return {} if self.publication is None else self.publication.bundles

    async def _change(self, group: Group, change: Callable[[Rollout], Rollout]) -> StoredRollout:
        stored = (await asyncio.to_thread(self.store.latest)).get(group)
        if stored is None:
            raise RolloutRefusedError(f"there was no rollout of {group.site}/{group.group}")
        changed = change(stored.rollout)
        if changed != stored.rollout and not await asyncio.to_thread(
            self.store.replace, stored, changed, self._clock()
        ):
            raise RolloutRefusedError("the rollout has changed in the meantime: look at it, and try again")
        await self.tick()
        return self.rollouts[group]

    async def _publish(self) -> None:
        """Read the publication if it has changed, and sign a timestamp if one is due."""
        try:
            stamp = await asyncio.to_thread(_stamp, self.folder)
            if stamp != self._stamp or self.publication is None:
                self.publication = await asyncio.to_thread(read_publication, self.folder)
                self._stamp = stamp
            last = await asyncio.to_thread(self.store.timestamp)
            now = datetime.datetime.fromtimestamp(self._clock(), datetime.UTC)
            made = next_timestamp(self.publication, last, load_online_key(self._key), now)
        except (PublicationError, KeyFileError, OSError) as error:
            if self.trouble != str(error):
                _log.error("bundles cannot be published", reason=str(error))
            self.trouble = str(error)
            return
        if made is not None:
            await asyncio.to_thread(self.store.save_timestamp, Metadata.from_bytes(made).signed.version, made)
            last = await asyncio.to_thread(self.store.timestamp)
        self.timestamp, self.trouble = last, ""

    async def _advance(self) -> None:
        now = self._clock()
        for group, stored in list(self.rollouts.items()):
            rollout = machine.advanced(stored.rollout, self.robots.get(group, {}), now)
            if rollout == stored.rollout or not await asyncio.to_thread(
                self.store.replace, stored, rollout, now
            ):
                continue
            self.rollouts[group] = StoredRollout(stored.number, rollout)
            if (rollout.state, rollout.ring) != (stored.rollout.state, stored.rollout.ring):
                _log.warning(
                    "a rollout has changed", bundle=rollout.path, state=rollout.state, why=rollout.why
                )

    def _wake(self) -> None:
        for listener in self.listeners:
            selection = self.selection(listener.robot, listener.group)
            if selection != listener.last:
                listener.last = selection
                listener.changed.set()


def _in_force_after(rollout: Rollout) -> str:
    """Return the bundle that a group has after its last rollout."""
    return rollout.path if rollout.state == "done" else rollout.before


def _stamp(folder: Path) -> _Stamp:
    """Return a stamp that changes when the published metadata change."""
    found = (
        (path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in (folder / "metadata").iterdir()
    )
    return tuple(sorted(found))
