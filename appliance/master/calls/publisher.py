"""Register the appliance's own node, which publishes for monitors and offers the appliance's service.

It needs no updates, so all calls of a master to its node API are only acknowledged.
"""

import asyncio
import ipaddress
from collections.abc import Callable, Collection
from dataclasses import KW_ONLY, dataclass

import structlog

from appliance.base import clock
from appliance.master.calls.call import ApiUri, Caller
from appliance.master.calls.registration import RegistrationCalls
from appliance.master.endpoints.node_ports import NoPortError
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import PUBLISHER_PATH, Incarnation, Kind, Registry
from appliance.rpc.server import Peer
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.uris import node_uri, parse_node_uri, parse_service_uri, service_uri

_log = structlog.get_logger()
_LOOPBACK = "127.0.0.1"
_AGAIN_SECONDS = 1.0


@dataclass(eq=False)
class OwnPublisher:
    """The node `name`, with exactly the publications in `wanted()` (topic to type) and the services in `services`."""

    registry: Registry
    graph: RosGraph
    registration: RegistrationCalls
    _: KW_ONLY
    name: str
    inner_port: int
    wanted: Callable[[], dict[str, str]]
    services: Collection[str]

    def __post_init__(self) -> None:
        uri = node_uri(_LOOPBACK, self.inner_port, PUBLISHER_PATH)
        self._api = ApiUri(uri, parse_node_uri(uri))
        # The relay answers the calls of the service, so the port in this URI can be any valid port.
        uri = service_uri(_LOOPBACK, self.inner_port)
        self._service_api = ApiUri(uri, parse_service_uri(uri))
        self._woken = asyncio.Event()
        self._woken.set()

    def wake(self) -> None:
        self._woken.set()

    async def run(self, ready: asyncio.Event) -> None:
        await ready.wait()
        while True:
            await self._woken.wait()
            self._woken.clear()
            try:
                await self._settle()
            except (CallFailedError, NoPortError) as error:
                _log.error("the publications of monitors are not registered", error=str(error))
                await asyncio.sleep(_AGAIN_SECONDS)
                self._woken.set()

    async def _settle(self) -> None:
        published = self.wanted()
        wanted = {Kind.PUBLICATION: published.keys(), Kind.SERVICE: self.services}
        for incarnation in self._mine():
            for kind, resource in list(incarnation.registrations):
                if incarnation.api_text != self._api.text or resource not in wanted.get(kind, ()):
                    self.graph.unregistered(incarnation, kind, resource)
        for topic, type_name in published.items():
            answer = await self.registration.register_publisher(self._caller(), topic, type_name, self._api)
            if answer[0] != 1:
                raise CallFailedError(f"{self.name} cannot publish {topic}: {answer[1]!s}")
        for service in self.services:
            answer = await self.registration.register_service(
                self._caller(), service, self._service_api, self._api
            )
            if answer[0] != 1:
                raise CallFailedError(f"{self.name} cannot offer {service}: {answer[1]!s}")

    def _caller(self) -> Caller:
        peer = Peer(ipaddress.ip_address(_LOOPBACK), _LOOPBACK, _LOOPBACK)
        return Caller(peer, self.name, clock.now_ns(), own=True)

    def _mine(self) -> list[Incarnation]:
        return [incarnation for incarnation in self.registry.live() if incarnation.of_monitors]
