"""State the registrations to the hidden ROS master, after the answers to nodes.

1. No answer to a node depends on a forwarded change. All reads of the graph are answered from the registry.
2. `_stated` has the registrations that the ROS master has, or will have after the one request under way. `_differing`
   has the keys that differ from it, in the order of their changes.
3. A request that fails is not repeated. It shuts the door, and the next round of the reconcile loop reads what the
   ROS master has (`adopt`), as after the death of control.
"""

import asyncio
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

import structlog

from appliance.master.graph.registry import Change, Incarnation, Kind, RegistrationKey, Registry
from appliance.master.graph.revocation import CALLS
from appliance.master.rosmaster import LARGEST_MULTICALL, RosMaster, Wanted
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.uris import service_uri

NAME = "/master"
_GATHER_SECONDS = 0.1  # gathered changes cost half the processor time

EntryKey = tuple[Kind, str, str]
"""The kind, the resource, and the name of the node."""

_log = structlog.get_logger()


class MasterEntry(NamedTuple):
    """The URI of a node, and the type of the topic or the URI of the service."""

    api: str
    detail: str


class MasterRegistrations:
    """The registrations at the ROS master. `pid` is the ROS master that has all of them."""

    def __init__(
        self, rosmaster: RosMaster, registry: Registry, inner_uri: Callable[[Incarnation], str]
    ) -> None:
        self._rosmaster = rosmaster
        self._registry = registry
        self._inner_uri = inner_uri
        self._stated: dict[EntryKey, MasterEntry] = {}
        self._differing: dict[EntryKey, None] = {}
        self._sending: asyncio.Task[None] | None = None
        self.pid: int | None = None

    def flush(self, changed: Iterable[Change]) -> None:
        for change in changed:
            if isinstance(change, Incarnation):
                for kind, resource in change.registrations:
                    self._compare((kind, resource, change.name))
            elif isinstance(change, RegistrationKey):
                self._compare((change.kind, change.resource, change.node.name))
        if self._differing and (self._sending is None or self._sending.done()):
            self._sending = asyncio.get_running_loop().create_task(self._send())

    def adopt(self, seen: Mapping[EntryKey, MasterEntry]) -> int:
        """Take over the ROS master's state. Return the number of differences from the wanted one."""
        self._stated = dict(seen)
        self._differing.clear()
        for node, registration in self._registry.in_order():
            self._compare((registration.kind, registration.resource, node.name))
        missing = len(self._differing)
        for key in sorted(seen):
            self._compare(key)
        return missing

    @property
    def differing(self) -> int:
        return len(self._differing)

    def take(self, most: int | None = None) -> list[Wanted]:
        calls: list[Wanted] = []
        for key in list(self._differing):
            if most is not None and len(calls) + 2 > most:
                break
            del self._differing[key]
            wanted, stated = self.wanted(key), self._stated.pop(key, None)
            calls += _calls(key, stated, wanted)
            if wanted is not None:
                self._stated[key] = wanted
        return calls

    def wanted(self, key: EntryKey) -> MasterEntry | None:
        kind, resource, name = key
        node = self._registry.holder(name)
        registration = None if node is None else node.registrations.get((kind, resource))
        if node is None or registration is None or kind is Kind.PARAMETER:
            return None
        service = kind is Kind.SERVICE
        return MasterEntry(self._inner_uri(node), stand_in(node) if service else registration.detail)

    def _compare(self, key: EntryKey) -> None:
        if self.wanted(key) == self._stated.get(key):
            self._differing.pop(key, None)
        else:
            self._differing[key] = None

    async def _send(self) -> None:
        while self._differing:
            if len(self._differing) < LARGEST_MULTICALL:
                await asyncio.sleep(_GATHER_SECONDS)
            await self._rosmaster.opened()
            part = self.take(LARGEST_MULTICALL)
            if not part:  # the changes have cancelled one another, or a round has sent them
                continue
            try:
                answers = await self._rosmaster.call_once(part)
            except CallFailedError as error:
                _log.warning("changes did not reach the ROS master", number=len(part), error=str(error))
                continue
            for (method, params), answer in zip(part, answers, strict=True):
                if isinstance(answer, CallFailedError) or answer[0] != 1:
                    _log.error(
                        "the ROS master rejected a change", call=method, of=params[:2], answer=str(answer)
                    )
                    self._rosmaster.doubtful.set()


def _calls(key: EntryKey, stated: MasterEntry | None, wanted: MasterEntry | None) -> Iterator[Wanted]:
    kind, resource, name = key
    register, unregister = CALLS[kind]
    if stated is not None and (wanted is None or wanted.api != stated.api):
        yield unregister, (name, resource, stated.detail if kind is Kind.SERVICE else stated.api)
    if wanted is not None:
        yield register, (name, resource, wanted.detail, wanted.api)


def stand_in(node: Incarnation) -> str:
    """Return the URI of a node's services at the ROS master. Clients never get it."""
    return service_uri(node.key, node.relay_port)
