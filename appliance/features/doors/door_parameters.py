"""Read, write and follow parameters for the connections of a door, which share one subscription for each parameter.

A read takes two calls for each of hundreds of parameters, so a connection's later requests, such as a stop, do not
wait for it. The hosts of clients take turns in reading.
"""

import asyncio
import sys
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from typing import Protocol
from weakref import WeakValueDictionary

import msgspec

from appliance.base.counted import counted
from appliance.features.doors.client_requests import (
    ReadParameters,
    SubscribeParameter,
    UnsubscribeParameter,
    WriteParameter,
)
from appliance.features.doors.door_memory import ClientMemory
from appliance.features.doors.host_shares import check_share
from appliance.features.doors.quotas import DOOR_PARAMETERS
from roswire.errors import LimitExceededError, ProtocolError, RosError, quote
from roswire.node import MasterDenialError, RosNode
from roswire.node.network import OwnedTasks
from roswire.xmlrpc import Value

TOO_MANY_CALLS = "too many calls of this door wait for answers; repeat it later: "
_MAX_READ = 1000  # of one request
_MAX_READS = 8  # of one connection that wait


class ParameterClient(Protocol):
    """A connection that reads parameters or subscribes to them."""

    @property
    def memory(self) -> ClientMemory:
        """Return the memory that is charged for the connection's requests."""

    def parameters(self, values: Mapping[str, object], reply_to: str | None) -> None:
        """Take the values of parameters."""

    def failed(self, request: ReadParameters, reason: str) -> None:
        """Take the refusal of a read."""

    def parameter_changed(self, subscribed: str, name: str, value: Value) -> None:
        """Take a new value. `name` is the subscribed parameter or a parameter below it; `value` is `{}` if it was
        deleted.
        """


class DoorParameters:
    """Carries out requests about parameters."""

    def __init__(self, node: RosNode, calls: ClientMemory) -> None:
        self._node = node
        self._calls = calls  # charged with the names in waiting reads
        self._clients: dict[str, set[ParameterClient]] = {}
        self._doubtful: set[str] = set()  # subscribed before the policy changed
        self._lock = asyncio.Lock()  # for registrations
        self._reads: Counter[ParameterClient] = Counter()  # that wait
        self._reading = asyncio.Lock()
        self._turns: WeakValueDictionary[Hashable, asyncio.Lock] = WeakValueDictionary()  # by host
        self._tasks = OwnedTasks()

    async def close(self) -> None:
        await self._tasks.close()

    def policy_changed(self) -> None:
        self._doubtful = {*self._clients}

    def begin_read(self, request: ReadParameters, client: ParameterClient) -> None:
        if self._reads[client] >= _MAX_READS:
            raise LimitExceededError(
                f"{_MAX_READS} reads of parameters wait for this client; repeat it later"
            )
        _check_number(request.names)
        size = sum(map(sys.getsizeof, request.names))
        self._calls.take(size, TOO_MANY_CALLS)
        self._reads[client] += 1
        self._tasks.start(self._read_for(request, client, size))

    async def _read_for(self, request: ReadParameters, client: ParameterClient, size: int) -> None:
        try:
            turn = self._turns.get(client.memory.host) or asyncio.Lock()
            self._turns[client.memory.host] = turn
            async with turn, self._reading:  # so the others wait for one read of this host
                if client in self._reads:  # else it left
                    values, denials = await self._read(request.names)
                    if values or not denials:
                        client.parameters(values, request.reply_to)
                    if denials:
                        raise ProtocolError(_in_words(denials))
        except RosError as error:
            client.failed(request, str(error))
        finally:
            self._calls.add(-size)
            if client in self._reads:
                self._reads[client] -= 1

    async def _read(self, names: Sequence[str]) -> tuple[dict[str, object], dict[str, str]]:
        """Return the values, and the reason for each parameter that the door may not read."""
        if not names:
            listed = await self._node.master("getParamNames")
            names = [name for name in listed if isinstance(name, str)] if isinstance(listed, list) else []
            _check_number(names)
        values: dict[str, object] = {}
        denials: dict[str, str] = {}
        for name in names:
            try:
                if await self._node.master("hasParam", name):
                    values[name] = await self._node.master("getParam", name)
            except MasterDenialError as denial:
                denials[name] = str(denial)
        return values, denials

    async def write(self, request: WriteParameter) -> None:
        if request.value is None:
            await self._node.master("deleteParam", request.name)
            return
        try:
            value = msgspec.json.decode(request.value)
        except (ValueError, RecursionError) as error:  # such as 1e999
            raise ProtocolError(f"the value of {quote(request.name)}: {error}") from None
        await self._node.set_parameter(request.name, value)

    async def carry_out(
        self, request: SubscribeParameter | UnsubscribeParameter, client: ParameterClient
    ) -> None:
        if isinstance(request, SubscribeParameter):
            await self._subscribe(request.name, client)
        else:
            self._unsubscribe([request.name], client)

    async def _subscribe(self, name: str, client: ParameterClient) -> None:
        async with self._lock:
            if name in self._clients:
                if name in self._doubtful:
                    await self._node.subscribe_parameter_again(name)
                    self._doubtful.discard(name)
                self._clients[name].add(client)
                return
            check_share("subscribed parameters", DOOR_PARAMETERS.bounds, [*self._clients.values()], client)
            self._clients[name] = {client}
            try:
                await self._node.subscribe_parameter(name, partial(self._changed, name))
            except BaseException:
                del self._clients[name]
                raise

    def _changed(self, subscribed: str, name: str, value: Value) -> None:
        for client in self._clients.get(subscribed, ()):
            client.parameter_changed(subscribed, name, value)

    def _unsubscribe(self, names: Sequence[str], client: ParameterClient) -> None:
        ended = [name for name in names if client in self._clients.get(name, ())]
        for name in ended:
            self._clients[name].discard(client)
        if ended:
            self._tasks.start(self._end(ended))

    def forget(self, client: ParameterClient) -> None:
        del self._reads[client]
        self._unsubscribe([*self._clients], client)

    async def _end(self, names: Sequence[str]) -> None:
        for name in names:
            async with self._lock:
                if name in self._clients and not self._clients[name]:
                    del self._clients[name]
                    await self._node.unsubscribe_parameter(name)


def _in_words(denials: Mapping[str, str]) -> str:
    first, more = next(iter(denials.values())), len(denials) - 1
    return first if not more else f"{first}; and {counted(more, 'other parameter')}"


def _check_number(names: Sequence[str]) -> None:
    if len(names) > _MAX_READ:
        raise LimitExceededError(f"{len(names)} parameters; name at most {_MAX_READ} of them")
