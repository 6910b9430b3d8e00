"""What monitors publish and the service that the appliance offers, as a node of the graph: it registers as any does.

Its node API is the listener of the inner faces, under a path of its own (`PUBLISHER_PATH`): there is nothing to tell
it, so every call of a master is acknowledged there. The relay serves its messages (`NodePlaced.monitors`).
"""

import asyncio
import ipaddress
import time
from collections.abc import Awaitable, Callable, Collection

import structlog

from appliance.master.caller import Answer, ApiUri, Caller
from appliance.master.endpoints.endpoint_addresses import NoPortError
from appliance.master.graph.graph import Graph
from appliance.master.graph.registry import PUBLISHER_PATH, Incarnation, Kind, Registry
from appliance.master.reconcile.enactor import Enactor
from appliance.master.reconcile.entries import Entries
from appliance.rpc.server import Peer
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.uris import node_uri, parse_node_uri, parse_service_uri, service_uri

_log = structlog.get_logger()
_LOOPBACK = "127.0.0.1"
_AGAIN_SECONDS = 1.0


class OwnPublisher:
    """Registers what `wanted()` says (topic to type) and `services`, and nothing else, under `name`.

    `register(caller, topic, type, api)` is `registerPublisher`, `offer(caller, service, service_api, api)`
    `registerService`.
    """

    def __init__(
        self,
        registry: Registry,
        graph: Graph,
        enactor: Enactor,
        entries: Entries,
        *,
        name: str,
        inner_port: int,
        wanted: Callable[[], dict[str, str]],
        services: Collection[str],
        register: Callable[[Caller, str, str, ApiUri], Awaitable[Answer]],
        offer: Callable[[Caller, str, ApiUri, ApiUri], Awaitable[Answer]],
    ) -> None:
        self._registry = registry
        self._graph = graph
        self._enactor = enactor
        self._entries = entries
        self._register = register
        self._offer = offer
        self._name = name
        uri = node_uri(_LOOPBACK, inner_port, PUBLISHER_PATH)
        self._api = ApiUri(uri, parse_node_uri(uri))
        # The relay answers calls itself: of the URI the port counts, and only for being one.
        uri = service_uri(_LOOPBACK, inner_port)
        self._service_api = ApiUri(uri, parse_service_uri(uri))
        self._wanted = wanted
        self._services = services
        self._woken = asyncio.Event()
        self._woken.set()

    def wake(self) -> None:
        """Other topics may be published."""
        self._woken.set()

    async def run(self, ready: asyncio.Event) -> None:
        """Register and unregister until cancelled; `ready` is set when ROSMaster is whole."""
        await ready.wait()
        while True:
            await self._woken.wait()
            self._woken.clear()
            try:
                await self._settle()
            except (CallFailedError, NoPortError) as error:
                _log.error("what monitors publish is not registered", error=str(error))
                await asyncio.sleep(_AGAIN_SECONDS)
                self._woken.set()

    async def _settle(self) -> None:
        published = self._wanted()
        wanted = {Kind.PUBLICATION: published.keys(), Kind.SERVICE: self._services}
        for incarnation in self._mine():
            for kind, resource in list(incarnation.registrations):
                if incarnation.api_text != self._api.text or resource not in wanted.get(kind, ()):
                    await self._entries.end(incarnation, kind, resource)
                    self._enactor.carry_out(self._graph.unregistered(incarnation, kind, resource))
        for topic, type_name in published.items():
            answer = await self._register(self._caller(), topic, type_name, self._api)
            if answer[0] != 1:
                raise CallFailedError(f"{self._name} cannot publish {topic}: {answer[1]!s}")
        for service in self._services:
            answer = await self._offer(self._caller(), service, self._service_api, self._api)
            if answer[0] != 1:
                raise CallFailedError(f"{self._name} cannot offer {service}: {answer[1]!s}")

    def _caller(self) -> Caller:
        peer = Peer(ipaddress.ip_address(_LOOPBACK), _LOOPBACK, _LOOPBACK)
        return Caller(peer, self._name, time.monotonic_ns(), own=True)

    def _mine(self) -> list[Incarnation]:
        return [incarnation for incarnation in self._registry.live() if incarnation.of_monitors]
