"""`/v1/policy/test`: the cases beside the policy file, run on a text that is not loaded."""

import asyncio
from typing import Annotated, Literal

import msgspec

from appliance.api.judgement import judge_text
from appliance.api.policy_models import Decided, Text
from appliance.api.roles import Viewer, ask
from appliance.api.routing import Routes, body
from appliance.api.services import Services
from appliance.channel.admin import PolicyWanted
from appliance.channel.answers.described import told

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
    """The route."""
    router = Routes(prefix="/v1/policy", tags=["policy"])

    @router.post("/test", operation_id="test_policy")
    async def test_policy(draft: Annotated[Draft, body(Draft)], bearer: Viewer) -> Tested:
        """Run the policy's tests on a text; nothing is loaded. A text with errors is refused with every finding."""
        current = await ask(services.control, PolicyWanted(), bearer)
        async with services.judging:
            ran = (await asyncio.to_thread(judge_text, draft.text, current, cases=True)).results
        cases = [
            Case(
                file=one.file,
                line=one.line,
                column=one.column,
                **one.request.fields(),
                expected="allow" if one.expected else "deny",
                decision=one.decision.word,
                reason=one.decision.reason,
                passed=one.passed,
            )
            for one in ran
        ]
        passed = sum(one.passed for one in cases)
        return Tested(
            file=current.cases_file,
            exists=current.cases is not None,
            passed=passed,
            failed=len(cases) - passed,
            cases=sorted(cases, key=lambda one: one.passed)[:_MOST_SHOWN],
        )

    return router
