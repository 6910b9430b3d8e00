"""Make findings with their places of control's texts about specifications."""

import re

from appliance.api.front.problems import Finding, ProblemError

_PLACE = re.compile(r"(?s)([^:]*+):([0-9]{1,9}+):([0-9]{1,9}+): (error|warning): (.*+)")


def findings_of(texts: list[str]) -> list[Finding]:
    return [
        Finding(file=file, line=int(line), column=int(column), severity=severity, text=text)
        for file, line, column, severity, text in (
            found.groups() for found in map(_PLACE.fullmatch, texts) if found is not None
        )
    ]


def refusal(error: str, findings: list[str]) -> ProblemError:
    return ProblemError(
        422,
        "specifications-refused",
        "\n".join([error, *findings[:200]]),
        findings=findings_of(findings) or None,
    )
