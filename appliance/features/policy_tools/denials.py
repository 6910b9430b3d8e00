"""Derive the denied request from the record of a denial, or the reason why no policy would allow the request."""

from collections.abc import Callable
from dataclasses import replace

import msgspec

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import rule_text
from appliance.audit.log.repetition import KIND
from appliance.channel.messages.relay_link import NO_GRANT
from appliance.features.policy_tools.grant import NO_DECISION, DecidedRequest, UngrantableError, asked
from appliance.policy.commands import CALLS
from appliance.policy.model import Category
from appliance.policy.policy_settings import AT_ONCE

_ASKS = {"topic": "requestTopic", "service": "lookupService"}
"""The calls that grant a connection, by category."""


def is_denial(record: AuditRecord) -> bool:
    return record.event in DENIALS and record.decision != "allow"


def asks_policy(record: AuditRecord) -> bool:
    try:
        return is_denial(record) and asked_of(record) is not None
    except UngrantableError:
        return False


def asked_of(record: AuditRecord) -> DecidedRequest:
    what = DENIALS.get(record.event)
    if what is None:
        raise UngrantableError(NO_DECISION)
    if isinstance(what, str):
        raise UngrantableError(f"no change of the policy would allow it: {what}")
    if record.rule is None and record.reason.startswith(f"{record.host} is blocked by "):  # `Policy.blocked`
        raise UngrantableError(
            "an operator's block denied it, not the policy; if the block is still in force (rosrv host blocks),"
            f" lift it: rosrv host unblock {record.host}"
        )
    return what(record)


def _of_decision(record: AuditRecord) -> DecidedRequest:
    found = asked(
        record.host or "", record.caller_id or "", record.category or "", record.resource or "", record.detail
    )
    return replace(found, takeover=AT_ONCE in record.reason)


def _of_revoked(record: AuditRecord) -> DecidedRequest:
    call = str(record.detail.get("call", ""))
    if not call:
        raise UngrantableError(
            "no change of the policy would have kept it: it was revoked for its recorded reason"
            " (or by an earlier version, whose records do not have the call that gave it)"
        )
    return _of_call(record, call)


def _of_connection(record: AuditRecord) -> DecidedRequest:
    call = _ASKS.get(record.category or "")
    if call is None or not record.reason.startswith(NO_GRANT) or record.decision is None:
        raise UngrantableError(
            "no change of the policy would allow it: the reason of the record says what to correct"
        )
    return _of_call(record, call)


def _of_call(record: AuditRecord, call: str) -> DecidedRequest:
    category, detail = CALLS[call].category, {**record.detail, "call": call}
    resource = record.resource
    if category is Category.COMMAND:
        resource, detail["key"] = call, record.resource
    return _of_decision(
        msgspec.structs.replace(record, category=category.value, resource=resource, detail=detail)
    )


def _of_folded(record: AuditRecord) -> DecidedRequest:
    detail = record.detail
    if detail.get("scope") != KIND:
        raise UngrantableError(
            f"it counts denials of many kinds; the first of them is record {detail.get('recorded_id')}"
        )
    return asked_of(msgspec.structs.replace(record, event=str(detail.get("of")), decision="deny"))


def _of_limited(record: AuditRecord) -> DecidedRequest:
    line = "a line of [Limits] that no longer exists" if record.rule is None else rule_text(record.rule)
    raise UngrantableError(f"no right is missing; more would pass with a higher limit at {line}")


DENIALS: dict[str, str | Callable[[AuditRecord], DecidedRequest]] = {
    "decision": _of_decision,
    "revoked": _of_revoked,
    "connection refused": _of_connection,
    "denials folded": _of_folded,
    "rate limited": _of_limited,
    "limit exceeded": "the bounds on what one peer may send, hold and open are settings"
    " (docs/reference/generated/quotas.md)",
    "malformed": "the data did not follow the protocol; the reason of the record says how",
    "message dropped": "the monitor dropped it; change its specification, or disable it (rosrv monitor disable)",
    "publication refused": "the specifications in force are for another type definition; load specifications for this"
    " one, or give the node theirs",
    "policy refused": "the policy itself was rejected; its findings say why",
    "specifications refused": "the specifications were rejected; their findings say why",
    "order refused": "tokens, their roles (rosrv token list) and signatures decide on REST, not the policy",
    "rest call": "tokens and their roles (rosrv token list) decide on REST, not the policy",
    "authority refused": "[Authority] and the present holder decide it (rosrv drive status)",
    "sign-on refused": "the provider and `sso.roles` decide who signs on",
    "door entry refused": "a valid ticket (rosrv door ticket NAME) or the address of its agent opens a door",
    "enrolment refused": "enrolment needs a valid one-time token (rosrv host add)",
    "renewal refused": "a host renews its certificate in its own tunnel",
    "tunnel refused": "a tunnel needs a valid certificate of this appliance (rosrv host list)",
    "packets refused": "replayed packets, and packets with the address of another host, are never accepted",
}
"""By event, the function that derives the request from a record, or the reason why no policy would allow it.

Every event that can be a denial has an entry.
"""
