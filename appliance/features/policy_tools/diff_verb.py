"""The command `rosrv policy diff`, for texts or for decisions on recorded requests."""

import contextlib
import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.counted import counted
from appliance.channel.admin import PolicyRevisions, PolicyRevisionWanted
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import by_host, say_diff, say_json
from appliance.features.policy_tools.diff import Difference, diff
from appliance.features.policy_tools.policy_input import (
    Enrolled,
    Robot,
    known_of,
    live_now,
    policy_in_force,
    read_text,
    requests_of_audit_log,
    requests_of_file,
    usage_error,
)
from appliance.features.policy_tools.policy_verbs import decision_fields
from appliance.policy.host_names import HostNames, in_words
from appliance.policy.judgement import PolicyContext
from appliance.policy.model import Request
from appliance.policy.policy import Policy
from appliance.policy.policy_findings import PolicyError
from appliance.policy.rights import Right
from rosmop.tool.terminal import refusal, say

_MAX_CALLERS = 4  # names in one line


@dataclass(frozen=True)
class _Source:
    name: str
    text: str


@speaks
def compare(
    appliance: Appliance,
    old: Annotated[
        str | None,
        typer.Argument(metavar="A", help="A file, or a revision's number", show_default=False),
    ] = None,
    new: Annotated[
        str | None,
        typer.Argument(metavar="B", help="A file, or a revision's number", show_default=False),
    ] = None,
    *,
    decisions: Annotated[
        bool,
        typer.Option("--decisions", help="List recorded requests that B decides differently from A"),
    ] = False,
    requests: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="With --decisions: requests as NDJSON (host, caller_id, category, resource) instead of the audit log",
        ),
    ] = None,
    robot: Robot = None,
    enrolled: Enrolled = None,
) -> None:
    """Compare the texts of two policies or, with --decisions, their decisions. Exit status 1 if they differ.

    Give a file or a revision to compare it with the policy in force. Give neither to show the last change.

    Example: rosrv policy diff next.ini
    """
    before, after = _sources(appliance, old, new)
    if decisions or requests is not None:
        known = _known(appliance, old, new, robot, enrolled)
        policies = _compile(before, known), _compile(after, known)
        differ = _say_decisions(appliance, *policies, requests)
    elif robot or enrolled:
        raise usage_error("--robot and --enrolled need --decisions")
    else:
        differ = _say_texts(appliance, before, after)
    raise typer.Exit(1 if differ else 0)


def _are_files(*words: str | None) -> bool:
    return all(word is not None and not word.isdecimal() for word in words)


def _sources(appliance: Appliance, old: str | None, new: str | None) -> tuple[_Source, _Source]:
    if old is not None and new is not None:
        return _source(appliance, old), _source(appliance, new)
    rows = appliance.ask_or_exit(PolicyRevisions()).revisions
    now = next(row.revision for row in rows if row.in_force)
    if old is not None:
        in_force, given = _revision(appliance, now, " (in force)"), _source(appliance, old)
        return (given, in_force) if old.isdecimal() else (in_force, given)
    previous = max((row.revision for row in rows if row.revision < now), default=None)
    if previous is None:
        raise usage_error(f"there is no kept revision before {now}: give a file to compare with")
    return _revision(appliance, previous), _revision(appliance, now, " (in force)")


def _source(appliance: Appliance, word: str) -> _Source:
    return _revision(appliance, int(word)) if word.isdecimal() else _Source(word, read_text(Path(word)))


def _revision(appliance: Appliance, number: int, note: str = "") -> _Source:
    text = appliance.ask_or_exit(PolicyRevisionWanted(number)).text
    return _Source(f"revision {number}{note}", text)


def _say_texts(appliance: Appliance, old: _Source, new: _Source) -> bool:
    was, now = old.text.splitlines(), new.text.splitlines()
    lines = list(difflib.unified_diff(was, now, old.name, new.name, lineterm=""))
    if appliance.as_json:
        say_json({"old": old.name, "new": new.name, "lines": lines})
    else:
        say_diff(lines)
    return bool(lines)


def _known(
    appliance: Appliance,
    old: str | None,
    new: str | None,
    robot: list[str] | None,
    enrolled: list[str] | None,
) -> PolicyContext:
    return (
        known_of(robot, enrolled) if _are_files(old, new) else policy_in_force(appliance, robot, enrolled)[2]
    )


def _compile(source: _Source, known: PolicyContext) -> Policy:
    try:
        return known.compile(source.text, source.name)
    except PolicyError as error:
        raise refusal(error.findings) from error


def _say_decisions(appliance: Appliance, old: Policy, new: Policy, requests: Path | None) -> bool:
    differences = diff(old, new, _requests(requests, appliance))
    if appliance.as_json:
        for difference in differences:
            say_json(_difference_fields(difference))
    else:
        labels = HostNames.of(new.text, new.enrolled, new.robot).labels()
        for host, its in by_host(differences, lambda one: str(one.request.host)):
            say(f"{in_words(host, labels)}: {counted(len(its), 'request')}")
            _say_requests(its)
        say(f"{counted(len(differences), 'request')} would be decided differently")
    return bool(differences)


def _requests(file: Path | None, appliance: Appliance) -> Iterator[Request | Right]:
    if file is not None:
        yield from requests_of_file(file)
    else:
        yield from requests_of_audit_log(appliance)
        with contextlib.suppress(NotRunningError):
            for live in live_now(appliance):
                yield from live.requests()


def _say_requests(differences: list[Difference]) -> None:
    equal: dict[tuple[str, ...], list[Difference]] = {}
    for one in differences:
        request = one.request
        key = one.word, request.category.value, request.resource, one.old.reason, one.new.reason
        equal.setdefault(key, []).append(one)
    for (word, category, resource, before, after), its in equal.items():
        style = "yellow" if its[0].granted else "red"
        callers = [one.request.caller_id for one in its if one.request.caller_id]
        named = ", ".join(callers[:_MAX_CALLERS]) or "clients without a name"
        more = f" and {len(callers) - _MAX_CALLERS} more" if len(callers) > _MAX_CALLERS else ""
        say(
            f"  {word}: {category} {resource} by {named}{more}, in {counted(sum(one.count for one in its), 'record')}",
            style,
        )
        say(f"    old: {before}", style)
        say(f"    new: {after}", style)


def _difference_fields(difference: Difference) -> dict[str, object]:
    return {
        **difference.request.fields(),
        "count": difference.count,
        "old": decision_fields(difference.old),
        "new": decision_fields(difference.new),
    }
