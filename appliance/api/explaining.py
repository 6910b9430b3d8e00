"""`/v1/policy/explain`: why a request is decided as it is, under the policy in force or another text."""

import asyncio
from typing import Annotated

from fastapi import Query

from appliance.api.access import Bearer
from appliance.api.judgement import explanation
from appliance.api.policy_models import Explained, LostRule, Question, RuleText
from appliance.api.roles import Viewer, ask
from appliance.api.routing import Routes, body
from appliance.api.services import Services
from appliance.channel.admin import PolicyWanted
from appliance.policy.explain import Explanation
from appliance.policy.model import Category, Rule


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1/policy", tags=["policy"])

    async def explained(question: Question, bearer: Bearer) -> Explained:
        current = await ask(services.control, PolicyWanted(), bearer)
        async with services.judging:
            found = await asyncio.to_thread(
                explanation,
                question.text,
                current,
                host=question.host,
                node=question.node,
                category=question.category,
                resource=question.resource,
            )
        return _explained(found)

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

    @router.post("/explain", operation_id="explain_under")
    async def explain_under(question: Annotated[Question, body(Question)], bearer: Viewer) -> Explained:
        """The same under another text, which is not loaded."""
        return await explained(question, bearer)

    return router


def _rule(rule: Rule) -> RuleText:
    return RuleText(section=rule.section, key=rule.key, file=rule.file, line=rule.line)


def _explained(found: Explanation) -> Explained:
    decision = found.decision
    return Explained(
        **found.request.fields(),
        decision=decision.word,
        rule=_rule(decision.rule) if decision.rule else None,
        reason=decision.reason,
        told=found.told,
        through=list(found.through),
        limit=found.limit,
        lost=[
            LostRule(rule=_rule(one.rule), would="allow" if one.grants else "deny", why=one.why)
            for one in found.lost
        ],
        node=_explained(found.node) if found.node is not None else None,
        command=_explained(found.command) if found.command is not None else None,
        allowed=found.allowed,
    )
