"""Reconcile the *wanted* state (the registry, the parameter mirror) with the *seen* state of the ROS master.

- A new ROS master gets everything again, in the original order. Calls wait at the door (`rosmaster.py`) until then.
- A registration that is seen but not wanted is ended: the registry is stored before the ROS master gets a change.
- After a rebuild, every subscriber gets its lists of publishers once. After a restart of control, every node gets the
  values of the parameters that it subscribed to.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import structlog

from appliance.base.counted import counted
from appliance.master.graph.registry import Kind, Registry
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.reconcile.subscribers import Subscribers
from appliance.master.rosmaster import NAME, EntryKey, MasterEntry, MasterRegistrations, RosMaster
from appliance.rpc.xmlrpc_client import CallFailedError
from appliance.telemetry.audit_trail import AuditTrail
from roswire.parameter_tree import Tree

_log = structlog.get_logger()
_RETRY_SECONDS = 0.1
_ROUND_SECONDS = 30.0


@dataclass(frozen=True, slots=True)
class Reconciler:
    """Runs a round whenever the ROS master is in doubt, and every `_ROUND_SECONDS`. The first success sets `ready`."""

    rosmaster: RosMaster
    entries: MasterRegistrations
    registry: Registry
    subscribers: Subscribers
    parameters: ParameterMirror
    trail: AuditTrail
    own_parameters: Callable[[], Tree]
    ready: asyncio.Event = field(default_factory=asyncio.Event, init=False)

    def wake(self) -> None:
        self.rosmaster.doubtful.set()

    async def run(self) -> None:
        while True:
            self.rosmaster.doubtful.clear()
            try:
                await self.round()
            except CallFailedError as error:
                self.rosmaster.shut()
                _log.warning("the ROS master is away", error=str(error))
                await asyncio.sleep(_RETRY_SECONDS)
                continue
            self.ready.set()
            try:
                async with asyncio.timeout(_ROUND_SECONDS):
                    await self.rosmaster.doubtful.wait()
            except TimeoutError:
                pass

    async def round(self) -> None:
        async with self.rosmaster.alone():
            pid = (await self.rosmaster.call_now("getPid", NAME))[2]
            if pid == self.entries.pid:
                await self._compare()
            elif (
                self.entries.pid is None
                and (await self.rosmaster.call_now("hasParam", NAME, "/run_id"))[2] is True
            ):
                tree = (await self.rosmaster.call_now("getParam", NAME, "/"))[2]
                self.parameters.replace(cast(Tree, tree))
                types = (await self.rosmaster.call_now("getTopicTypes", NAME))[2]
                self.registry.adopt_types(cast(list[tuple[str, str]], types))
                await self._compare()
            else:
                await self._rebuild()
            # An earlier control process may not have sent the last values.
            for node in self.registry.live() if self.entries.pid is None else ():
                self.subscribers.tell_parameters(node)
            self.entries.pid = cast(int, pid)

    # --- a new ROS master ---

    async def _rebuild(self) -> None:
        self.rosmaster.shut()
        tree = {**self.own_parameters(), **self.parameters.tree}
        await self.rosmaster.call_now("setParam", NAME, "/", tree)
        self.parameters.replace(tree)
        self.registry.forget_types()
        made = self.entries.adopt({})
        await self.rosmaster.all_now(self.entries.take())
        self.subscribers.remind_all()
        if made:
            text = (
                f"{counted(made, 'registration')} and {counted(len(tree), 'parameter namespace')} were"
                " restored in a new ROS master"
            )
            self.trail.happened("reconciled", text, registrations=made)

    # --- the same ROS master ---

    async def _compare(self) -> None:
        made = self.entries.adopt(await self._seen())
        ended = self.entries.differing - made
        await self.rosmaster.all_now(self.entries.take())
        if made or ended:
            text = f"{counted(made, 'registration was', 'registrations were')} made again, {ended} removed"
            self.trail.happened("reconciled", text, made=made, settled=ended)

    async def _seen(self) -> dict[EntryKey, MasterEntry]:
        state = (await self.rosmaster.call_now("getSystemState", NAME))[2]
        publishers, subscribers, services = cast(list[list[tuple[str, list[str]]]], state)
        keys = [
            (kind, resource, name)
            for kind, rows in (
                (Kind.PUBLICATION, publishers),
                (Kind.SUBSCRIPTION, subscribers),
                (Kind.SERVICE, services),
            )
            for resource, holders in rows
            for name in holders
        ]
        uris = await self._addresses("lookupNode", {name for _kind, _resource, name in keys})
        offered = await self._addresses(
            "lookupService", {resource for kind, resource, _name in keys if kind is Kind.SERVICE}
        )
        return {
            key: self._entry(key, uris[key[2]], offered.get(key[1], ""))
            for key in keys
            if key[2] in uris and (key[0] is not Kind.SERVICE or key[1] in offered)
        }

    def _entry(self, key: EntryKey, api: str, service: str) -> MasterEntry:
        """Return an entry as the ROS master has it; it does not report the type, so the wanted one is assumed."""
        wanted = self.entries.wanted_entry(key)
        return MasterEntry(
            api, service if key[0] is Kind.SERVICE else wanted.detail if wanted is not None else ""
        )

    async def _addresses(self, method: str, names: set[str]) -> dict[str, str]:
        asked = sorted(names)
        answers = await self.rosmaster.all_now([(method, (NAME, name)) for name in asked])
        return {name: str(answer[2]) for name, answer in zip(asked, answers, strict=True) if answer[0] == 1}
