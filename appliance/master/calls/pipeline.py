"""Serve requests of the Master API and of proxy endpoints, from the body to the written answer."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import structlog

from appliance.base import clock
from appliance.master.calls.call import Attempt, Caller, Table
from appliance.master.calls.call_execution import Execution, ServedRequest
from appliance.master.calls.multicall import LIMIT_FAULT, MULTICALL, PARSE_FAULT, Multicall
from appliance.master.calls.request_peek import method_named
from appliance.master.endpoints.node_ports import AdvertisedAddresses
from appliance.master.graph.registry import Incarnation
from appliance.policy.model import Address, Category
from appliance.rpc.fair_queue import Bulk, Turns, weigh
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import Handler, HttpRequest, Peer
from appliance.telemetry.audit_trail import AuditTrail
from roswire.errors import EncodingError, LimitExceededError, PeerError
from roswire.xmlrpc import MethodCall, Value, XmlRpcLimits, build_fault, build_response, parse_call

_log = structlog.get_logger()
_INTERNAL_FAULT = -32603


@dataclass(frozen=True, slots=True)
class Pipeline:
    """Serves requests by a table of calls.

    Hosts take turns (`bulk`) for bodies and answers over `offload` bytes, which threads parse and write.
    """

    execution: Execution
    multicall: Multicall
    addresses: AdvertisedAddresses
    trail: AuditTrail
    limits: XmlRpcLimits
    offload: int
    bulk: Turns[Address]
    processor: ProcessorTime
    before_answer: Callable[[], Awaitable[None]] | None = None

    def handler(self, table: Table, target: Incarnation | None = None, *, own: bool = False) -> Handler:

        async def handle(request: HttpRequest) -> bytes:
            await self.addresses.learn(request.peer)
            caller = Caller(request.peer, "", request.arrived, own=own, target=target)
            with Bulk(self.bulk, caller.peer.host, self.processor) as bulk:
                answer = await self._serve(ServedRequest(table, caller, bulk), request.body)
            if self.before_answer is not None and not own:
                await self.before_answer()
            return answer

        return handle

    async def run_order(self, table: Table, peer: Peer, call: MethodCall) -> Value:
        """Carry out a call of a node that an operator orders, with policy, quotas and records as for the node's own."""
        await self.addresses.learn(peer)
        caller = Caller(peer, "", clock.now_ns())
        with Bulk(self.bulk, peer.host, self.processor) as bulk:
            answer = await self._answer(ServedRequest(table, caller, bulk), call)
        if self.before_answer is not None:
            await self.before_answer()
        return answer

    async def _serve(self, visit: ServedRequest, body: bytes) -> bytes:
        try:
            if len(body) <= self.offload:
                call = parse_call(body, self.limits)
            else:
                call = await self._parse_large(body, visit.bulk)
        except PeerError as error:
            return self._not_understood(visit.caller, body, error)
        try:
            answer = await self._answer(visit, call)
            known = call.method in visit.table or call.method == MULTICALL
            seconds = (clock.now_ns() - visit.caller.arrived) / 1e9
            self.trail.meter.count_call(call.method if known else "unknown", seconds)
            if weigh(answer, self.offload) < self.offload:
                return build_response(answer)
            await visit.bulk.take()
            return await visit.bulk.in_thread(build_response, answer)
        except EncodingError as error:
            _log.error("answer cannot be written", call=call.method, error=str(error))
            return build_fault(_INTERNAL_FAULT, f"the answer to {call.method} cannot be written: {error}")

    async def _answer(self, visit: ServedRequest, call: MethodCall) -> Value:
        if call.method == MULTICALL and visit.caller.target is None:
            return await self.multicall.answer(visit, call.params)
        attempt = await self.execution.understand(visit, call.method, call.params)
        return await self.execution.answer(visit, attempt) if isinstance(attempt, Attempt) else attempt

    async def _parse_large(self, body: bytes, bulk: Bulk) -> MethodCall:
        bulk.large = True
        await bulk.take()
        try:
            return await bulk.in_thread(parse_call, body, self.limits)
        finally:
            bulk.give_back()  # other hosts must not wait while the call is carried out

    def _not_understood(self, caller: Caller, body: bytes, error: PeerError) -> bytes:
        limit = isinstance(error, LimitExceededError)
        decision = self.trail.happened(
            "limit exceeded" if limit else "malformed",
            str(error),
            decision="deny",
            host=caller.peer.text,
            category=Category.COMMAND.value,
            resource=method_named(body),
        )
        return build_fault(LIMIT_FAULT if limit else PARSE_FAULT, f"{error} [{decision}]")
