"""What goes wrong, as clients see it: problem details (RFC 9457), one form for every error."""

import http
import json
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

MEDIA_TYPE = "application/problem+json"
REASON = "rosrv.reason"  # the key of a request's scope that has why it was answered as it was
_MOST_FINDINGS = 200


class Finding(BaseModel):
    """One thing wrong with a text that was sent; `line` and `column` count from 1."""

    model_config = ConfigDict(extra="forbid")
    file: str
    line: int
    column: int
    severity: str
    text: str


class BadInput(BaseModel):
    """One part of a request that makes no sense."""

    model_config = ConfigDict(extra="forbid")
    where: str = Field(description="for example `query.limit` or `body.revision`")
    text: str


class Problem(BaseModel):
    """Problem details; `line` and `column` are those of the first finding."""

    model_config = ConfigDict(extra="forbid")
    type: str = Field(description="stable name of the kind of problem: urn:rosrv:problem:…")
    title: str
    status: int
    detail: str = Field(description="what happened and what to do, for a person")
    line: int | None = None
    column: int | None = None
    findings: list[Finding] | None = None
    errors: list[BadInput] | None = None


class ProblemError(Exception):
    """Answers the request with a problem. `kind` is the end of its type, `retry_after` seconds."""

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
        self.line = findings[0].line if findings else line
        self.column = findings[0].column if findings else column

    def response(self) -> Response:
        """The problem as an answer."""
        body: dict[str, Any] = {
            "type": f"urn:rosrv:problem:{self.kind}",
            "title": http.HTTPStatus(self.status).phrase,
            "status": self.status,
            "detail": self.detail,
        }
        if self.line is not None:
            body |= {"line": self.line, "column": self.column}
        if self.findings is not None:
            body["findings"] = [one.model_dump() for one in self.findings[:_MOST_FINDINGS]]
        if self.errors is not None:
            body["errors"] = [one.model_dump() for one in self.errors[:_MOST_FINDINGS]]
        return Response(json.dumps(body), self.status, self.headers, MEDIA_TYPE)


def defect(error: Exception) -> ProblemError:
    """What a client is told of a defect of ours: its kind, nothing of what it was about."""
    return ProblemError(500, "defect", f"a defect of rosrv, please report it: {type(error).__name__}")
