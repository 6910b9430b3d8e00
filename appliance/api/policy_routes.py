"""`/v1/policy`: look at the policy in force and at those before it; why a request is decided as it is; the tests."""

import asyncio
from dataclasses import asdict
from typing import Annotated, Literal

import msgspec
from fastapi import Query

from appliance.api.access import Bearer
from appliance.api.dry_run_policy import explanation, judge_text
from appliance.api.policy_models import Decided, Explained, LostRule, OneRevision, Question, RuleText, Text
from appliance.api.route_roles import Viewer, add_look, ask
from appliance.api.routing import Responses, Routes, Tagged, body, tagged
from appliance.api.services import Services
from appliance.channel.admin import PolicyRevisions, PolicyWanted
from appliance.channel.answers.field_docs import told
from appliance.channel.answers.policy_answers import PolicyInForce, RevisionText
from appliance.policy.cases import CaseResult
from appliance.policy.decision_reasons import Explanation
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
    expected: Literal["allow", "deny"]
    decision: Decided
    reason: str
    passed: bool


class Tested(msgspec.Struct, frozen=True, kw_only=True):
    """The cases of the policy's tests, at most a thousand of them; none when the file does not exist."""

    file: str
    exists: bool
    passed: int
    failed: int
    cases: Annotated[list[Case], told("those that failed first")]


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1/policy", tags=["policy"])
    control = services.control

    @router.get("")
    async def policy(bearer: Viewer) -> Tagged[PolicyInForce]:
        """The policy in force, with its ETag."""
        known = await ask(control, PolicyWanted(), bearer)
        return tagged(msgspec.convert(known, PolicyInForce, from_attributes=True))

    add_look(router, control, PolicyRevisions)

    @router.get("/revisions/{revision}", operation_id="policy_revision", responses=_UNKNOWN)
    async def revision_text(revision: OneRevision, bearer: Viewer) -> RevisionText:
        """A kept revision with its text."""
        known = await ask(control, PolicyWanted(revision), bearer)
        return msgspec.convert(known, RevisionText, from_attributes=True)

    async def explained(question: Question, bearer: Bearer) -> Explained:
        current = await ask(control, PolicyWanted(), bearer)
        async with services.judging:
            asked = msgspec.structs.asdict(question)
            return _explained(await asyncio.to_thread(explanation, current=current, **asked))

    @router.get("/explain", operation_id="explain")
    async def explain_request(
        bearer: Viewer,
        host: Annotated[str, Query(min_length=1, max_length=100, description="an address, or `robot`")],
        category: Category,
        resource: Annotated[str, Query(min_length=1, max_length=256)],
        node: Annotated[
            str, Query(max_length=256, description="the name it gives, where a node is needed")
        ] = "",
    ) -> Explained:
        """Why the policy in force decides a request as it does."""
        return await explained(Question(host=host, node=node, category=category, resource=resource), bearer)

    @router.post("/explain")
    async def explain_under(question: Annotated[Question, body(Question)], bearer: Viewer) -> Explained:
        """The same under another text, which is not loaded."""
        return await explained(question, bearer)

    @router.post("/test")
    async def test_policy(draft: Annotated[Draft, body(Draft)], bearer: Viewer) -> Tested:
        """Run the policy's tests on a text; nothing is loaded. A text with errors is refused with every finding."""
        current = await ask(control, PolicyWanted(), bearer)
        async with services.judging:
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
        expected="allow" if case.expected else "deny",
        decision=case.decision.word,
        reason=case.decision.reason,
        passed=case.passed,
    )


def _explained(found: Explanation) -> Explained:
    decision = found.decision
    return Explained(
        **found.request.fields(),
        decision=decision.word,
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
