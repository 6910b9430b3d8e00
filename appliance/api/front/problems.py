"""Errors as clients get them: problem details (RFC 9457)."""

import http
from collections.abc import Mapping
from typing import Annotated

import msgspec
from starlette.responses import Response

from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.monitor_answers import Finding, findings_of

MEDIA_TYPE = "application/problem+json"
REASON = "rosrv.reason"  # the key of a request's scope for the reason of its answer
_MAX_FINDINGS = 200


class BadInput(msgspec.Struct, frozen=True):
    """One invalid part of a request."""

    where: Annotated[str, doc("for example `query.limit` or `body.revision`")]
    text: Annotated[str, doc("the error")]


class Problem(msgspec.Struct, frozen=True, omit_defaults=True):
    """Problem details; `line` and `column` are those of the first finding."""

    type: Annotated[str, doc("stable name of the kind of problem: urn:rosrv:problem:…")]
    title: Annotated[str, doc("kind of problem, in words")]
    status: Annotated[int, doc("HTTP status")]
    detail: Annotated[str, doc("the cause and what to do, for a person")]
    line: Annotated[int | None, doc("from 1")] = None
    column: Annotated[int | None, doc("from 1")] = None
    findings: Annotated[list[Finding] | None, doc("all findings")] = None
    errors: Annotated[
        list[BadInput] | None, doc("each invalid part of the request, or null for another problem")
    ] = None
    active: Annotated[str | None, doc("address of the active appliance (problem `standby`)")] = None


class ProblemError(Exception):
    """An error for the client; `kind` is the end of the problem's type, and `retry_after` is in seconds."""

    def __init__(
        self,
        status: int,
        kind: str,
        detail: str,
        *,
        headers: Mapping[str, str] | None = None,
        retry_after: int | None = None,
        findings: list[Finding] | None = None,
        errors: list[BadInput] | None = None,
        line: int | None = None,
        column: int | None = None,
        active: str | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.kind = kind
        self.detail = detail
        self.headers = dict(headers or {})
        if retry_after is not None:
            self.headers["Retry-After"] = str(retry_after)
        self.findings = findings
        self.errors = errors
        self.active = active
        self.line = findings[0].line if findings else line
        self.column = findings[0].column if findings else column

    def response(self) -> Response:
        problem = Problem(
            f"urn:rosrv:problem:{self.kind}",
            http.HTTPStatus(self.status).phrase,
            self.status,
            self.detail.encode("utf-8", "backslashreplace").decode(),
            line=self.line,
            column=self.column,
            findings=self.findings[:_MAX_FINDINGS] if self.findings is not None else None,
            errors=self.errors[:_MAX_FINDINGS] if self.errors is not None else None,
            active=self.active,
        )
        return Response(msgspec.json.encode(problem), self.status, self.headers, MEDIA_TYPE)


def too_many(kind: str, detail: str, seconds: float) -> ProblemError:
    return ProblemError(429, kind, detail, retry_after=int(seconds) + 1)


def bad_input(wrong: list[BadInput], *, besides: str = "") -> ProblemError:
    detail = "; ".join(f"{problem.where}: {problem.text}" for problem in wrong[:5])
    return ProblemError(422, "bad-input", detail + besides, errors=wrong)


def defect(error: Exception) -> ProblemError:
    """Return the answer to a defect, which reveals only the type of the error."""
    return ProblemError(500, "defect", f"a defect of rosrv, please report it: {type(error).__name__}")


def refusal(error: str, findings: list[str]) -> ProblemError:
    return ProblemError(
        422,
        "specifications-refused",
        "\n".join([error, *findings[:_MAX_FINDINGS]]),
        findings=findings_of(findings) or None,
    )
