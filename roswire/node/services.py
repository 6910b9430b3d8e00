"""The services of a node: calls of other nodes' services, and the services that it offers."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass

from roswire.definitions import Definitions
from roswire.errors import PeerError, ProtocolError
from roswire.node.network import ByteWriter, PeerUnreachableError, ServiceFailedError
from roswire.node.tcpros_streams import ANY, exchange_headers, held_frame, refuse
from roswire.node.topics import NodeLink
from roswire.tcpros import (
    encode_frame,
    encode_header,
    encode_service_error,
    encode_service_reply,
)
from roswire.uris import NodeUri

_IDLE_SECONDS = 3600.0  # a persistent connection without a request


@dataclass(frozen=True, slots=True)
class ServiceType:
    """A service type as connection headers describe it."""

    name: str
    md5sum: str
    request: str
    response: str

    @classmethod
    def of(cls, definitions: Definitions, name: str) -> "ServiceType":
        service = definitions.service(name)
        return cls(name, definitions.service_md5sum(name), service.request.name, service.response.name)


async def probe_service(link: NodeLink, service: str, uri: NodeUri) -> dict[str, str]:
    fields = {"callerid": link.name, "service": service, "md5sum": ANY, "probe": "1"}
    header, _reply = await _exchange(
        link, service, uri, fields, request=b"", seconds=link.limits.call_seconds
    )
    return header


async def call_service(
    link: NodeLink, service: str, uri: NodeUri, *, md5sum: str, request: bytes, seconds: float
) -> bytes:
    fields = {"callerid": link.name, "service": service, "md5sum": md5sum, "persistent": "0"}
    _header, reply = await _exchange(
        link, service, uri, fields, request=encode_frame(request), seconds=seconds
    )
    return reply


async def _exchange(
    link: NodeLink, service: str, uri: NodeUri, fields: Mapping[str, str], *, request: bytes, seconds: float
) -> tuple[dict[str, str], bytes]:
    """Return the header and the reply of a service. Without a request, wait for no reply."""
    try:
        async with asyncio.timeout(seconds):
            reader, writer = await link.network.connect(uri.host, uri.port)
            try:
                header = await exchange_headers(reader, writer, fields, link.limits.header_seconds)
                if not request:
                    return header, b""
                writer.write(request)
                await writer.drain()
                return header, await _read_reply(link, reader)
            finally:
                writer.close()
    except TimeoutError:
        raise PeerUnreachableError(f"{service} did not answer within {seconds:g} s") from None
    except OSError as error:
        raise PeerUnreachableError(f"{service} cannot be called: {error.strerror or error}") from error


async def _read_reply(link: NodeLink, reader: asyncio.StreamReader) -> bytes:
    ok = await reader.read(1)
    async with held_frame(reader, link.limits.message_bytes, link.arriving) as body:
        if ok == b"\x01":
            return body
        if ok == b"\x00":
            raise ServiceFailedError(body[:4000].decode("utf-8", "replace"))
    raise ProtocolError(f"service reply: the first byte is {ok[0]}; it is 1 (success) or 0 (error)")


class ServiceServer:
    """An offered service. `answer` returns the serialised response, or raises `ServiceFailedError`."""

    def __init__(
        self, link: NodeLink, name: str, kind: ServiceType, answer: Callable[[bytes], Awaitable[bytes]]
    ) -> None:
        self.name = name
        self.type = kind
        self._link = link
        self._answer = answer

    async def serve(
        self, reader: asyncio.StreamReader, writer: ByteWriter, header: Mapping[str, str]
    ) -> None:
        if header.get("md5sum") not in (ANY, self.type.md5sum):
            refuse(writer, f"{self.name} has the type {self.type.name} with the md5sum {self.type.md5sum}")
            return
        fields = {
            "callerid": self._link.name,
            "md5sum": self.type.md5sum,
            "type": self.type.name,
            "request_type": self.type.request,
            "response_type": self.type.response,
        }
        writer.write(encode_header(fields))
        if header.get("probe") == "1":
            return
        while True:
            async with contextlib.AsyncExitStack() as stack:
                async with asyncio.timeout(_IDLE_SECONDS):
                    request = await stack.enter_async_context(
                        held_frame(reader, self._link.limits.message_bytes, self._link.arriving)
                    )
                writer.write(await self._reply(request))
                await writer.drain()
            if header.get("persistent") != "1":
                return

    async def _reply(self, request: bytes) -> bytes:
        try:
            return encode_service_reply(await self._answer(request))
        except (ServiceFailedError, PeerError) as error:
            return encode_service_error(str(error))
