import ipaddress
from dataclasses import replace
from typing import get_args, get_type_hints

import msgspec
import pytest

from appliance.audit.log.events import EVENTS
from appliance.audit.log.record import AuditRecord, RuleReference
from appliance.channel.answers.policy_answers import PolicyKnown, Why
from appliance.channel.messages.relay_link import Violation
from appliance.features.policy_tools.explanations import DENIALS, asks_policy, explained, grant_of, is_denial
from appliance.features.policy_tools.grant import UngrantableError
from appliance.master.graph.graph import Grants, RosGraph
from appliance.master.graph.registry import Registry
from appliance.policy.live_rights import LiveRight, may_keep
from appliance.policy.model import Decision
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_settings import AT_ONCE
from appliance.telemetry.audit_trail import rule_reference
from distribution.generated_pages import uses
from tests.support.core import FakeTrail
from tests.support.idle import idle

HOST = "10.0.0.9"
CLOSED = "[Nodes]\ndefault = 10.0.0.1\n[Publishers]\n/x = 10.0.0.1\n[Parameters]\nread default = 10.0.0.1\n"


def known(text: str = CLOSED) -> PolicyKnown:
    unknown = dict.fromkeys(get_type_hints(PolicyKnown))
    given = {
        "text": text, "file": "p.ini", "revision": 3, "hosts": {}, "robot": [], "site_keys": [], "blocks": {},
        "approved": [],
    }  # fmt: skip
    return PolicyKnown(**(unknown | given | {"cases_file": ""}))  # type: ignore[arg-type]  # what it is judged by


def denied(event: str, reason: str = "because", **fields: object) -> AuditRecord:
    about = {"host": HOST, "caller_id": "/it", "category": "publish", "resource": "/x", "decision": "deny"}
    return AuditRecord(id="1", time=1, event=event, reason=reason, **(about | fields))  # type: ignore[arg-type]  # fields of it


def revoked(decision: Decision, category: str, call: str) -> AuditRecord:
    trail = FakeTrail()
    graph = RosGraph(idle(Registry), idle(Grants), trail)
    graph.record_revocation(decision, HOST, "/it", category, "/x", call=call)
    return trail.records[0]


def why(record: AuditRecord, text: str = CLOSED) -> Why:
    return explained(record, known(text) if asks_policy(record) else None)


def allowing(found: Why) -> list[str]:
    start = "would be allowed by: "
    return [line.removeprefix(start) for line in found.lines if line.startswith(start)]


def test_every_event_of_a_denial_has_its_row() -> None:
    refusing = {use.event for use in uses() if use.denies} | {*get_args(Violation)} - {""}
    refusing |= {"decision", "denials folded"}  # their decision is computed
    refusing |= {"specifications refused", "policy refused", "rate limited", "message dropped"}
    assert refusing == set(DENIALS)
    assert set(DENIALS) <= set(EVENTS)


@pytest.mark.parametrize("event", EVENTS)
def test_every_denial_names_the_change_that_allows_it(event: str) -> None:
    found = why(denied(event))
    assert (bool(allowing(found)) != bool(found.refusal)) is (event in DENIALS)
    assert not is_denial(denied(event, decision="allow"))


@pytest.mark.parametrize(
    ("call", "category"),
    [
        ("registerPublisher", "publication"),
        ("registerSubscriber", "subscription"),
        ("registerService", "service"),
        ("subscribeParam", "parameter"),
        ("requestTopic", "topic"),
        ("lookupService", "service"),
    ],
)
@pytest.mark.parametrize("namespace", [False, True])
def test_the_change_lets_a_revoked_grant_be_kept(call: str, category: str, *, namespace: bool) -> None:
    live = LiveRight(ipaddress.ip_address(HOST), "/it", call, "/x", namespace)
    decision = may_keep(compile_policy(CLOSED, file="p.ini"), live)
    record = revoked(decision, category, call)
    text = CLOSED
    for _ in range(3):  # a parameter below a namespace may be denied next
        found = why(record, text)
        assert allowing(found)
        assert found.grant is not None
        text = found.grant.text
        if (decision := may_keep(compile_policy(text, file="p.ini"), live)).allowed:
            break
        record = denied("revoked", category=category, detail={"call": call, "needs": decision.needs})
    assert decision.allowed
    assert "has every right" in why(record, text).refusal


def test_denials_without_a_policy_are_not_blamed_on_it() -> None:
    live = LiveRight(ipaddress.ip_address(HOST), "/it", "registerPublisher", "/x")
    decision = may_keep(compile_policy(CLOSED, file="p.ini"), live)
    assert not revoked(decision, "publication", "").detail
    found = why(denied("revoked", category="publication"))
    assert (allowing(found), "its recorded reason" in found.refusal) == ([], True)


def test_a_connection_without_a_grant() -> None:
    reason = f"no grant for [/it] at {HOST} to subscribe to [/x]; requestTopic comes first"
    found = why(denied("connection refused", reason, category="topic"))
    assert allowing(found) == ["[Subscribers] /x = 10.0.0.9", "/it = 10.0.0.1 10.0.0.9"]
    assert found.grant is not None
    assert (
        "has every right"
        in why(denied("connection refused", reason, category="topic"), found.grant.text).refusal
    )
    service = f"no grant for [/it] at {HOST} to call [/s]; lookupService comes first"
    found = why(denied("connection refused", service, category="service", resource="/s"))
    assert allowing(found) == ["[Commands] lookupService = 10.0.0.9"]
    gone = why(denied("connection refused", "[/that] is not a publisher of [/x]", category="topic"))
    own = why(denied("connection refused", reason, category="topic", decision=None))
    for other in (gone, own):
        assert (allowing(other), "no change of the policy" in other.refusal) == ([], True)


def test_a_name_that_another_host_has() -> None:
    held = f"/it is held by a running node on 10.0.0.1 (or at once with {AT_ONCE})"
    all_may = "[Nodes]\ndefault = *\n[Publishers]\n/x = *\n"
    for options, line in {
        "": AT_ONCE,
        "[Options]\ntell = rule\n": "takeover = granted",
        "[Options]\ntakeover = same-host  # theirs\n": "takeover = granted",
    }.items():
        found = why(denied("decision", held), all_may + options)
        assert allowing(found) == [line]
        assert found.grant is not None
        assert compile_policy(found.grant.text, file="p.ini").takeover == "granted"
        assert not allowing(why(denied("decision", "the limit for one host"), all_may + options))


def test_repetitions_and_limits() -> None:
    one = {"scope": "kind", "of": "decision", "recorded_id": "7"}
    assert allowing(why(denied("denials folded", detail=one))) == [
        "/x = 10.0.0.1 10.0.0.9",
        "/it = 10.0.0.1 10.0.0.9",
    ]
    assert "record 7" in why(denied("denials folded", detail=one | {"scope": "all"})).refusal
    rule = RuleReference("Limits", "/x", "p.ini", 9)
    assert "[Limits] /x p.ini:9" in why(denied("rate limited", rule=rule, decision=None)).refusal


@pytest.mark.parametrize("lifted", [False, True])
@pytest.mark.parametrize("event", ["decision", "revoked", "denials folded"])
def test_a_block_is_lifted_and_no_policy_is_changed(event: str, *, lifted: bool) -> None:
    host = ipaddress.ip_address(HOST)
    blocks = {host: "blocked by ann until noon: odd; lift it with `rosrv host unblock 10.0.0.9`"}
    live = LiveRight(host, "/it", "registerPublisher", "/x")
    decision = may_keep(replace(compile_policy(CLOSED, file="p.ini"), blocks=blocks), live)
    kind = {"scope": "kind", "of": "decision", "recorded_id": "7"}
    record = denied(event, decision.reason, rule=rule_reference(decision.rule), detail=kind)
    current = known() if lifted else msgspec.structs.replace(known(), blocks={HOST: blocks[host]})
    assert not asks_policy(record)
    found = explained(record, current)
    assert (found.grant, allowing(found)) == (None, [])
    assert found.refusal.endswith(": rosrv host unblock 10.0.0.9")
    with pytest.raises(UngrantableError, match=f"rosrv host unblock {HOST}$"):
        grant_of(record, current)


def test_a_name_like_a_block_is_not_a_block() -> None:
    for reason, rule in (
        ("10.0.0.1 is blocked by ann", None),
        (f"{HOST} is blocked by ann", RuleReference("Publishers", "/x", "p.ini", 4)),
    ):
        assert asks_policy(denied("decision", reason, rule=rule))
