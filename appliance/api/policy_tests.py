"""`/v1/policy/test`: the cases beside the policy file, run on a text that is not loaded."""

import asyncio
from typing import Annotated, Literal

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from appliance.api.judgement import judge_text
from appliance.api.roles import Viewer, ask
from appliance.api.services import Services
from appliance.channel.admin import PolicyWanted

_MOST_SHOWN = 1000


class Draft(BaseModel):
    """The text to run them on; null: the policy in force."""

    model_config = ConfigDict(extra="forbid")
    text: Annotated[str, StringConstraints(min_length=1, max_length=1 << 20)] | None = None


class Case(BaseModel):
    """One case: what it expects, and what is decided; `line` and `column` are its place in `file`."""

    model_config = ConfigDict(extra="forbid")
    file: str
    line: int
    column: int
    host: str
    caller_id: str
    category: str
    resource: str
    expected: Literal["allow", "deny"]
    decision: Literal["allow", "deny", "would deny"]
    reason: str
    passed: bool


class Tested(BaseModel):
    """The cases of the policy's tests, at most a thousand of them; none when the file does not exist."""

    model_config = ConfigDict(extra="forbid")
    file: str
    exists: bool
    passed: int
    failed: int
    cases: list[Case] = Field(description="those that failed first")


def routes(services: Services) -> APIRouter:
    """The route."""
    router = APIRouter(prefix="/v1/policy", tags=["policy"])

    @router.post("/test", operation_id="test_policy")
    async def test_policy(draft: Draft, bearer: Viewer) -> Tested:
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
            file=current["cases_file"],
            exists=current["cases"] is not None,
            passed=passed,
            failed=len(cases) - passed,
            cases=sorted(cases, key=lambda one: one.passed)[:_MOST_SHOWN],
        )

    return router
