"""Reconcile the *wanted* state (the registry, the parameter mirror) with the *seen* state of the ROS master.

The same loop handles all failures: the ROS master died, control died, a call was interrupted.

- A new ROS master gets everything again, in the original order. Calls wait at the door (`rosmaster.py`) until then.
- A registration that is wanted but not seen is made again.
- A registration that is seen but not wanted is adopted if two conditions hold: it has the key of a known incarnation,
  and the policy in force grants it. In this case, control died before it saved the registration. Otherwise, the
  registration is ended. A registration at the ROS master is not a right: the policy may have withdrawn it just before.
- After a rebuild, and after a relay starts, every subscriber gets each of its lists of publishers once. After a restart
  of control, every node gets the values of the parameters that it subscribed to.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import structlog

from appliance.master.endpoints.proxy_endpoints import ProxyEndpoints
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.parameter_updates import settled
from appliance.master.graph.registry import Kind, Life, Registry
from appliance.master.graph.revocation import CALLS, Revocation
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.reconcile.enactor import Enactor
from appliance.master.reconcile.entries import NAME, NO_SERVICE, MasterRegistrations, stand_in
from appliance.master.rosmaster import RosMaster, together
from appliance.rpc.xmlrpc_client import CallFailedError
from appliance.telemetry.audit_trail import AuditTrail
from roswire.parameter_tree import Tree, standing_at

_log = structlog.get_logger()
_RETRY_SECONDS = 0.1
_ROUND_SECONDS = 30.0
Seen = set[tuple[Kind, str, str]]


@dataclass(frozen=True, slots=True)
class Reconciler:
    """Run a round whenever the ROS master is in doubt, and every `_ROUND_SECONDS`. The first success sets `ready`."""

    rosmaster: RosMaster
    entries: MasterRegistrations
    registry: Registry
    faces: ProxyEndpoints
    graph: RosGraph
    revocation: Revocation
    enactor: Enactor
    parameters: ParameterMirror
    trail: AuditTrail
    own_parameters: Callable[[], Tree]
    ready: asyncio.Event = field(default_factory=asyncio.Event, init=False)

    def wake(self) -> None:
        """Run a round now."""
        self.rosmaster.doubtful.set()

    async def run(self) -> None:
        """Run rounds until cancelled; repeat a failed round until it succeeds."""
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
        """Compare the ROS master with the registry once, and remove all differences."""
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
                self._tell_parameters()
            else:
                await self._rebuild()
            self.entries.pid = cast(int, pid)

    def _tell_parameters(self) -> None:
        """Send the values of parameters that an earlier control process may not have sent."""
        for node, registration in self.registry.in_order():
            if registration.kind is Kind.PARAMETER:
                value, _ = standing_at(self.parameters.tree, registration.resource)
                told = {} if value is None else settled(value)
                self.enactor.carry_out(self.graph.tell_parameter(node, registration.resource, told))

    # --- a new ROS master ---

    async def _rebuild(self) -> None:
        self.rosmaster.shut()
        tree = {**self.own_parameters(), **self.parameters.tree}
        await self.rosmaster.call_now("setParam", NAME, "/", tree)
        self.parameters.replace(tree)
        self.registry.forget_types()
        made = len(await together(self.entries.make(*pair) for pair in self.registry.in_order()))
        self.enactor.carry_out(self.graph.tell_everybody())
        if made:
            text = (
                f"{made} registrations and {len(tree)} parameter namespaces were restored in a new ROS master"
            )
            self.trail.happened("reconciled", text, registrations=made)

    # --- the same ROS master ---

    async def _compare(self) -> None:
        seen = await self._seen()
        wanted = {
            (registration.kind, registration.resource, incarnation.name): (incarnation, registration)
            for incarnation, registration in self.registry.in_order()
            if registration.kind
            is not Kind.PARAMETER  # the ROS master does not list subscribers to parameters
        }
        uris = await self._inner_uris({name for _kind, _resource, name in seen})
        missing = await together(
            self.entries.make(*pair)
            for key, pair in wanted.items()
            if key not in seen or uris.get(pair[0].name) != self.faces.inner_uri(pair[0])
        )
        extra = sorted(entry for entry in seen if entry not in wanted)
        if extra:
            rows = (await self.rosmaster.call_now("getTopicTypes", NAME))[2]
            types = dict(cast(list[tuple[str, str]], rows))
            await together(
                self._settle(kind, what, name, uris.get(name), types) for kind, what, name in extra
            )
        if missing or extra:
            text = f"{len(missing)} registrations were made again, {len(extra)} adopted or removed"
            self.trail.happened("reconciled", text, made=len(missing), settled=len(extra))

    async def _seen(self) -> Seen:
        state = (await self.rosmaster.call_now("getSystemState", NAME))[2]
        publishers, subscribers, services = cast(list[list[tuple[str, list[str]]]], state)
        return {
            (kind, resource, name)
            for kind, rows in (
                (Kind.PUBLICATION, publishers),
                (Kind.SUBSCRIPTION, subscribers),
                (Kind.SERVICE, services),
            )
            for resource, holders in rows
            for name in holders
        }

    async def _inner_uris(self, nodes: set[str]) -> dict[str, str]:
        names = sorted(nodes)
        answers = await asyncio.gather(*(self.rosmaster.call_now("lookupNode", NAME, name) for name in names))
        return {name: str(answer[2]) for name, answer in zip(names, answers, strict=True) if answer[0] == 1}

    async def _settle(
        self, kind: Kind, resource: str, name: str, inner: str | None, types: dict[str, str]
    ) -> None:
        incarnation = self.faces.by_inner_uri(inner) if inner is not None else None
        if (
            incarnation is not None
            and incarnation.life is Life.LIVE
            and kind is not Kind.SERVICE
            and incarnation.name == name
            and (kind, resource) not in incarnation.shelf
            and self.revocation.may_have(incarnation, kind, resource)
        ):
            adopted = self.graph.registered(incarnation, kind, resource, types.get(resource, "*"))
            self.enactor.carry_out(adopted)
            return
        # The ROS master does not know the real port of a service. So a service that was not saved is unregistered.
        call = self.rosmaster.call_now
        if kind is Kind.SERVICE:
            uri = stand_in(incarnation) if incarnation is not None else NO_SERVICE
            await call("unregisterService", name, resource, uri)
        elif inner is not None:
            await call(CALLS[kind][1], name, resource, inner)
