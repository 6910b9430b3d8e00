"""`/v1/policy`, with the report of a load, `explain`, `uses` and `test`; `/v1/audit/ID/why` and `grant`."""

import asyncio
from collections.abc import Iterable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
from fastapi import Query

from appliance.api.front.access import Bearer
from appliance.api.front.moments import parse_moment
from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import Viewer, ask, ask_optional
from appliance.api.front.routing import Responses, Routes, Tagged, body, with_tag
from appliance.api.front.services import Services
from appliance.api.routes.log_reader import UNKNOWN, LogReader, OneRecord, readable_by
from appliance.api.routes.named_hosts import HostLabels, host_in_words, labels_of
from appliance.api.routes.operation_routes import Answer, AnsweringRoutes, OperationCall
from appliance.audit.log.record_format import LogEntry
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export, recorded_in_full
from appliance.channel.admin import PolicyLoad, PolicyWanted, RegistrationsWanted
from appliance.channel.answers.graph_answers import Registration
from appliance.channel.answers.policy_answers import Granted, PolicyInForce, PolicyKnown, Why
from appliance.features.policy_tools.decision_reasons import DecisionExplanation
from appliance.features.policy_tools.dry_run_policy import judge_change
from appliance.features.policy_tools.explanations import (
    asks_policy,
    explained,
    explanation,
    grant_of,
    judge_text,
)
from appliance.features.policy_tools.grant import UngrantableError
from appliance.features.policy_tools.policy_input import RecordedPeriod, period_since
from appliance.features.policy_tools.policy_models import (
    Case,
    Draft,
    Explained,
    LostRule,
    PolicyUses,
    Question,
    Report,
    RuleText,
    RuleUsed,
    Tested,
)
from appliance.features.policy_tools.rule_uses import RuleUses
from appliance.policy.cases import CaseResult
from appliance.policy.judgement import PolicyContext
from appliance.policy.live_rights import LiveRight
from appliance.policy.model import Category

# The policy in force, and the report of a load.


def _of_texts(services: Services) -> Routes:
    router = Routes(prefix="/policy", tags=["policy"])
    control = services.control

    @router.get("")
    async def policy(bearer: Viewer) -> Tagged[PolicyInForce]:
        """Return the policy in force, with its ETag."""
        known = await ask(control, PolicyWanted(), bearer)
        return with_tag(msgspec.convert(known, PolicyInForce, from_attributes=True))

    @router.get("/hosts")
    async def host_names(bearer: Viewer) -> HostLabels:
        """Return the names of hosts: enrolled hosts, `robot` and groups of the policy in force, with their networks."""
        known = await ask(control, PolicyWanted(), bearer)
        return await asyncio.to_thread(labels_of, known)

    return router


async def _load(call: OperationCall[PolicyLoad]) -> Tagged[Report]:
    order, services = call.order, call.services
    current = await call.ask(PolicyWanted())
    if order.expected not in (None, current.revision):
        text = f"revision {current.revision} is in force, not {order.expected}"
        raise ProblemError(412, "changed-meanwhile", text)
    live = (await call.ask(RegistrationsWanted())).registrations
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
            return with_tag(report)
        loaded = await call.ask(order)
    return with_tag(
        msgspec.structs.replace(
            report,
            loaded=True,
            revision=loaded.revision,
            replaced=loaded.replaced,
            revoked=loaded.revoked,
            confirm_by=loaded.confirm_by,
        )
    )


# Find the uses of each rule of the policy in force, for `/v1/policy/uses`.

MAX_READ = 100_000
"""The most records that one request reads, newest first in each kind. With more, what was not seen is unknown."""


def policy_uses(
    path: Path, current: PolicyKnown, registrations: Iterable[Registration], since: int, most: int = MAX_READ
) -> PolicyUses:
    """Return the uses since a time (nanoseconds since the epoch). Raises `LogUnreadableError`."""
    known = PolicyContext.of(msgspec.structs.asdict(current))
    policy = known.complete(known.compile(current.text, current.file))
    records = _NewestRecords(path, most)
    period: RecordedPeriod = replace(period_since(partial(export, path), since, since), read=records)
    uses = RuleUses(policy)
    for observation in period.requests():
        uses.add(observation)
    uses.add_live(LiveRight.of(msgspec.structs.asdict(row)) for row in registrations)
    removed = period.removed or records.cut
    return PolicyUses(
        revision=current.revision,
        since=period.start / 1e9,
        whole=not removed,
        rules=[
            RuleUsed(
                RuleText(row.rule.section, row.rule.key, row.rule.file, row.rule.line),
                row.state,
                row.used,
                list(row.unused),
                list(row.unknown),
                list(row.ended),
            )
            for row in uses.rules(period.unnamed, removed=removed)
        ],
    )


class _NewestRecords:
    """Reads at most `left` records, newest first; `cut`: there are more."""

    def __init__(self, path: Path, left: int) -> None:
        self._path, self._left = path, left
        self.cut = False

    def __call__(self, wanted: Filter) -> Iterator[LogEntry]:
        for entry in export(self._path, wanted, newest_first=True):
            if self._left == 0:
                self.cut = True
                return
            self._left -= 1
            yield entry


_NO_GRANT: Responses = {409: {"description": "No line of a policy grants it."}}
_MAX_SHOWN = 1000


def routes(services: Services) -> Routes:
    router = AnsweringRoutes({"load_policy": Answer(_load)}, prefix="/v1")
    router.include_router(_of_texts(services))
    router.include_router(_of_policy(services))
    router.include_router(_of_records(services))
    return router


def _of_policy(services: Services) -> Routes:
    router = Routes(prefix="/policy", tags=["policy"])
    control, desk = services.control, LogReader(services)

    async def explain(question: Question, bearer: Bearer) -> Explained:
        current = await ask(control, PolicyWanted(), bearer)
        async with services.judging.turn(bearer):
            asked = msgspec.structs.asdict(question)
            return _explain(await asyncio.to_thread(explanation, current=current, **asked))

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
        return await explain(Question(host=host, node=node, category=category, resource=resource), bearer)

    @router.post("/explain")
    async def explain_under(question: Annotated[Question, body(Question)], bearer: Viewer) -> Explained:
        """Explain the decision of a request under another text, which is not loaded."""
        return await explain(question, bearer)

    @router.get("/uses", operation_id="policy_uses")
    async def uses(
        bearer: Viewer,
        since: Annotated[
            str, Query(max_length=64, description="30d (ago), a date, or RFC 3339", examples=["7d"])
        ] = "30d",
    ) -> PolicyUses:
        """Return the rules of the policy in force that recorded requests used, as `rosrv policy unused` does."""
        moment = parse_moment(since)
        current = await ask(control, PolicyWanted(), bearer)
        live = (await ask(control, RegistrationsWanted(), bearer)).registrations
        return await desk.read(bearer, policy_uses, desk.path, current, live, moment)

    @router.post("/test")
    async def test_policy(draft: Annotated[Draft, body(Draft)], bearer: Viewer) -> Tested:
        """Run the policy's tests on a text; nothing is loaded. A text with errors is refused with every finding."""
        current = await ask(control, PolicyWanted(), bearer)
        async with services.judging.turn(bearer):
            ran = (await asyncio.to_thread(judge_text, draft.text, current, cases=True)).results
        cases = sorted(map(_case, ran), key=lambda case: case.passed)
        passed = sum(case.passed for case in cases)
        return Tested(
            file=current.cases_file,
            exists=current.cases is not None,
            passed=passed,
            failed=len(cases) - passed,
            cases=cases[:_MAX_SHOWN],
        )

    return router


def _of_records(services: Services) -> Routes:
    router = Routes(prefix="/audit", tags=["audit"])
    desk = LogReader(services)

    @router.get("/{record_id}/why", responses=UNKNOWN)
    async def why_of_record(record_id: OneRecord, bearer: Viewer) -> Why:
        """Explain a record: its cause, the deciding events and values (not for viewers), and the places in
        the text.

        For a monitor's verdict, these events alone lead to it. For a denial, the answer has the smallest
        change of the policy in force that would allow it.
        """
        shown = await desk.record(bearer, record_id, 0)
        record = readable_by(shown.entry, bearer).record
        first = await desk.read(bearer, recorded_in_full, desk.path, shown.entry)
        in_full = None if first is None else readable_by(first, bearer)
        needed = asks_policy(record)
        control = services.control
        policy = await (ask if needed else ask_optional)(control, PolicyWanted(), bearer)
        known = policy if needed else None
        async with services.judging.turn(bearer):
            words = await asyncio.to_thread(host_in_words, policy)
            return await asyncio.to_thread(explained, record, known, in_full, words)

    @router.get("/{record_id}/grant", responses=UNKNOWN | _NO_GRANT)
    async def grant_of_record(
        record_id: OneRecord,
        bearer: Viewer,
        *,
        tool: bool = False,
        until: Annotated[
            str,
            Query(
                max_length=32, description="end of the right: a date in the policy's zone, or 7d (from now)"
            ),
        ] = "",
    ) -> Granted:
        """Return the smallest change of the policy in force that grants the denied request of this record.

        With `tool`, the change also grants all other rights that the stock tool of the record (such as rostopic)
        needs.
        """
        shown = await desk.record(bearer, record_id, 0)
        known = await ask(services.control, PolicyWanted(), bearer)
        async with services.judging.turn(bearer):
            try:
                return await asyncio.to_thread(
                    grant_of, shown.entry.record, known, whole_tool=tool, until=until
                )
            except UngrantableError as error:
                raise ProblemError(409, "not-by-a-policy", str(error)) from None

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


def _explain(decision_explanation: DecisionExplanation) -> Explained:
    decision = decision_explanation.decision
    return Explained(
        **decision_explanation.request.fields(),
        decision=decision.verdict,
        rule=RuleText(**asdict(decision.rule)) if decision.rule else None,
        reason=decision.reason,
        told=decision_explanation.told,
        through=list(decision_explanation.through),
        limit=decision_explanation.limit,
        carried=decision_explanation.carried,
        lost=[
            LostRule(
                rule=RuleText(**asdict(rule.rule)), would="allow" if rule.grants else "deny", why=rule.why
            )
            for rule in decision_explanation.lost
        ],
        node=_explain(decision_explanation.node) if decision_explanation.node is not None else None,
        command=_explain(decision_explanation.command) if decision_explanation.command is not None else None,
        allowed=decision_explanation.allowed,
    )
