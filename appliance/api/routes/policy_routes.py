"""`/v1/policy`: the policy in force, revisions, explanations, its tests, and the report of a load."""

import asyncio
from dataclasses import asdict
from typing import Annotated, Literal

import msgspec
from fastapi import Query
from msgspec.structs import replace

from appliance.api.front.access import Bearer
from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import Viewer, ask
from appliance.api.front.routing import Responses, Routes, Tagged, body, tagged
from appliance.api.front.services import Services
from appliance.api.routes.dry_run_policy import explanation, judge_change, judge_text
from appliance.api.routes.named_hosts import HostLabels, labels_of
from appliance.api.routes.operation_routes import Answer, OperationCall
from appliance.api.routes.policy_models import Decided, Explained, LostRule, Question, Report, RuleText
from appliance.channel import admin
from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.channel.rest_bodies import Text
from appliance.policy.cases import CaseResult
from appliance.policy.decision_reasons import DecisionExplanation
from appliance.policy.model import Category

_UNKNOWN: Responses = {404: {"description": "There is no such revision."}}
_MOST_SHOWN = 1000


class Draft(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The text to run them on; null: the policy in force."""

    text: Text | None = None


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """One case: what it expects, and what is decided; `line` and `column` are its place in `file`."""

    file: str
    line: int
    column: int
    host: str
    caller_id: str
    category: str
    resource: str
    expected: Literal["allow", "deny", "ask"]
    decision: Decided
    reason: str
    passed: bool


class Tested(msgspec.Struct, frozen=True, kw_only=True):
    """The cases of the policy's tests, at most a thousand of them; none when the file does not exist."""

    file: str
    exists: bool
    passed: int
    failed: int
    cases: Annotated[list[Case], doc("failed cases first")]


def routes(services: Services) -> Routes:
    router = Routes(prefix="/v1/policy", tags=["policy"])
    control = services.control

    @router.get("")
    async def policy(bearer: Viewer) -> Tagged[PolicyInForce]:
        """Return the policy in force, with its ETag."""
        known = await ask(control, admin.PolicyWanted(), bearer)
        return tagged(msgspec.convert(known, PolicyInForce, from_attributes=True))

    @router.get("/hosts")
    async def host_names(bearer: Viewer) -> HostLabels:
        """Return the names of hosts: enrolled hosts, `robot` and groups of the policy in force, with their networks."""
        known = await ask(control, admin.PolicyWanted(), bearer)
        return await asyncio.to_thread(labels_of, known)

    async def explained(question: Question, bearer: Bearer) -> Explained:
        current = await ask(control, admin.PolicyWanted(), bearer)
        async with services.judging.turn(bearer):
            asked = msgspec.structs.asdict(question)
            return _explained(await asyncio.to_thread(explanation, current=current, **asked))

    @router.get("/explain", operation_id="explain")
    async def explain_request(
        bearer: Viewer,
        host: Annotated[
            str, Query(min_length=1, max_length=100, description="an address, or the name of a host")
        ],
        category: Category,
        resource: Annotated[str, Query(min_length=1, max_length=256)],
        node: Annotated[
            str,
            Query(
                max_length=256, description="the node name that the host gives, if the action needs a node"
            ),
        ] = "",
    ) -> Explained:
        """Why the policy in force decides a request as it does."""
        return await explained(Question(host=host, node=node, category=category, resource=resource), bearer)

    @router.post("/explain")
    async def explain_under(question: Annotated[Question, body(Question)], bearer: Viewer) -> Explained:
        """Return the same under another text, which is not loaded."""
        return await explained(question, bearer)

    @router.post("/test")
    async def test_policy(draft: Annotated[Draft, body(Draft)], bearer: Viewer) -> Tested:
        """Run the policy's tests on a text; nothing is loaded. A text with errors is refused with every finding."""
        current = await ask(control, admin.PolicyWanted(), bearer)
        async with services.judging.turn(bearer):
            ran = (await asyncio.to_thread(judge_text, draft.text, current, cases=True)).results
        cases = sorted(map(_case, ran), key=lambda case: case.passed)
        passed = sum(case.passed for case in cases)
        return Tested(
            file=current.cases_file,
            exists=current.cases is not None,
            passed=passed,
            failed=len(cases) - passed,
            cases=cases[:_MOST_SHOWN],
        )

    return router


def _case(case: CaseResult) -> Case:
    return Case(
        file=case.file,
        line=case.line,
        column=case.column,
        **case.request.fields(),
        expected=case.expected,
        decision=case.decision.verdict,
        reason=case.decision.reason,
        passed=case.passed,
    )


def _explained(found: DecisionExplanation) -> Explained:
    decision = found.decision
    return Explained(
        **found.request.fields(),
        decision=decision.verdict,
        rule=RuleText(**asdict(decision.rule)) if decision.rule else None,
        reason=decision.reason,
        told=found.told,
        through=list(found.through),
        limit=found.limit,
        lost=[
            LostRule(
                rule=RuleText(**asdict(rule.rule)), would="allow" if rule.grants else "deny", why=rule.why
            )
            for rule in found.lost
        ],
        node=_explained(found.node) if found.node is not None else None,
        command=_explained(found.command) if found.command is not None else None,
        allowed=found.allowed,
    )


async def _load(call: OperationCall[admin.PolicyLoad]) -> Tagged[Report]:
    order, services = call.order, call.services
    current = await call.ask(admin.PolicyWanted())
    if order.expected not in (None, current.revision):
        text = f"revision {current.revision} is in force, not {order.expected}"
        raise ProblemError(412, "changed-meanwhile", text)
    live = (await call.ask(admin.RegistrationsWanted())).registrations
    try:
        async with services.judging.turn(call.bearer) if call.dry_run else services.ordering:
            report = await asyncio.to_thread(judge_change, order, current, live)
    except ProblemError as refusal:
        if call.dry_run:
            raise
        # Control decides and records the rejection; this process adds the findings with their places.
        try:
            loaded = await call.ask(order)
        except ProblemError as said:
            raise refusal if said.kind == "refused" else said from None
        report = Report(loaded=False, revision=0, warnings=[], changes=[], ends=[])
    else:
        if call.dry_run:
            return tagged(report)
        loaded = await call.ask(order)
    return tagged(
        replace(
            report,
            loaded=True,
            revision=loaded.revision,
            replaced=loaded.replaced,
            revoked=loaded.revoked,
            confirm_by=loaded.confirm_by,
        )
    )


ANSWERS = {"load_policy": Answer(_load)}
