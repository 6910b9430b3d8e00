"""How the policy verbs show things: coloured on a terminal, plain otherwise, JSON when asked for.

A stranger's strings (names, file names, whatever stands in a log) never reach a terminal with control
characters in them, and are never read as markup.
"""

import json
import sys

from rich.console import Console
from rich.text import Text

from appliance.policy import Decision, Finding, Request


def printable(text: str) -> str:
    """The text with everything that a terminal could act on escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def counted(number: int, noun: str) -> str:
    """`1 error`, `2 errors`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def say(line: str, style: str = "") -> None:
    """Write one line to standard output."""
    shown = printable(line)
    if sys.stdout.isatty():
        Console(highlight=False, soft_wrap=True).print(Text(shown, style=style))
    else:
        sys.stdout.write(shown + "\n")


def say_json(fields: dict[str, object]) -> None:
    """Write one object on one line to standard output."""
    sys.stdout.write(json.dumps(fields) + "\n")


def say_finding(finding: Finding, *, as_json: bool) -> None:
    """Write an error or a warning."""
    if as_json:
        say_json(
            {
                "file": finding.file,
                "line": finding.line,
                "column": finding.column,
                "severity": finding.severity,
                "text": finding.text,
            }
        )
    else:
        say(str(finding), "red" if finding.severity == "error" else "yellow")


def request_fields(request: Request) -> dict[str, object]:
    """A request as the audit log writes it."""
    return {
        "host": str(request.host),
        "caller_id": request.caller_id,
        "category": request.category,
        "resource": request.resource,
    }


def decision_fields(decision: Decision) -> dict[str, object]:
    """A decision as the audit log writes it."""
    rule = decision.rule
    answer = "would deny" if decision.would_deny else "allow" if decision.allowed else "deny"
    place = {"section": rule.section, "key": rule.key, "file": rule.file, "line": rule.line} if rule else None
    return {"decision": answer, "rule": place, "reason": decision.reason}
