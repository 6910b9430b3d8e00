"""After a change of the policy, everything that is live is decided again; what is no longer allowed is taken back."""

import asyncio
import ipaddress

import structlog

from appliance.audit.record import Severity
from appliance.master.client import CallFailedError
from appliance.master.core import Master
from appliance.master.registration import withdraw
from appliance.master.registry import Incarnation, Kind, Registration
from appliance.master.relays import TOPIC
from appliance.policy.model import Address, Category, Decision, Request
from appliance.store.state import PermissionRow

_log = structlog.get_logger()
_CATEGORIES = {
    Kind.PUBLICATION: Category.PUBLISH,
    Kind.SUBSCRIPTION: Category.SUBSCRIBE,
    Kind.SERVICE: Category.OFFER,
}


class Revocation:
    """Decides again what the registry and the relay's grants hold."""

    def __init__(self, master: Master) -> None:
        self._master = master
        self._telling: set[asyncio.Task[None]] = set()

    def redecide(self) -> int:
        """Take back what the running policy no longer allows; how much that was."""
        count = 0
        for incarnation, registration in list(self._master.registry.in_order()):
            decision = self._decide(incarnation, registration)
            if not decision.allowed:
                self._master.graph.revoked(incarnation, registration, decision)
                self._tell(incarnation, registration)
                count += 1
        for row in self._master.relay.permissions():
            decision = self._decide_permission(row)
            if not decision.allowed:
                self._master.relay.revoke(row)
                self._record(row, decision)
                count += 1
        return count

    def expel(self, host: Address, reason: str) -> int:
        """Take back all that a host has, whatever the policy says; how much that was."""
        decision, count = Decision(False, None, reason), 0
        for incarnation, registration in list(self._master.registry.in_order()):
            if incarnation.host == host and not incarnation.own:
                self._master.graph.revoked(incarnation, registration, decision)
                self._tell(incarnation, registration)
                count += 1
        for row in self._master.relay.permissions():
            if row.host == str(host):
                self._master.relay.revoke(row)
                self._record(row, decision)
                count += 1
        return count

    def _decide(self, incarnation: Incarnation, registration: Registration) -> Decision:
        if incarnation.own:
            return Decision(True, None, "the appliance's own node")
        gate, policy = self._master.gate, self._master.policy()
        name, host = incarnation.name, incarnation.host
        if registration.kind is Kind.PARAMETER:
            decision = gate.may_be_node(Request(host, name, Category.COMMAND, "subscribeParam"))
            if decision.allowed and policy.has_section(Category.READ):
                decision = policy.decide_parameter(
                    Request(host, name, Category.READ, registration.resource), subtree=True
                )
            return decision
        return gate.may_be_node(Request(host, name, _CATEGORIES[registration.kind], registration.resource))

    def _decide_permission(self, row: PermissionRow) -> Decision:
        gate, host = self._master.gate, ipaddress.ip_address(row.host)
        if row.kind == TOPIC:
            holder = self._master.registry.holder(row.caller_id)
            if holder is not None and holder.own:
                return Decision(True, None, "the appliance's own node")
            return gate.may_be_node(Request(host, row.caller_id, Category.SUBSCRIBE, row.resource))
        decision = gate.may(Request(host, row.caller_id, Category.CALL, row.resource))
        if decision.allowed:
            decision = gate.may(Request(host, row.caller_id, Category.COMMAND, "lookupService"))
        return decision

    def _tell(self, incarnation: Incarnation, registration: Registration) -> None:
        async def tell() -> None:
            try:
                await withdraw(self._master, incarnation, registration.kind, registration.resource)
            except CallFailedError as error:
                _log.warning(
                    "ROSMaster was not told", node=incarnation.name, error=str(error)
                )  # reconcile will

        task = asyncio.get_running_loop().create_task(tell())
        self._telling.add(task)
        task.add_done_callback(self._telling.discard)

    def _record(self, row: PermissionRow, decision: Decision) -> None:
        self._master.recorder.happened(
            "revoked",
            decision.reason,
            severity=Severity.WARNING,
            decision="deny",
            host=row.host,
            caller_id=row.caller_id,
            category=row.kind,
            resource=row.resource,
            rule=decision.rule,
        )
