"""The command `rosrv policy enforce`."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
import typer

from appliance.base.counted import counted
from appliance.base.timestamps import local_text
from appliance.channel.admin import PolicyLoad
from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.cli.commit_confirm import ConfirmWithin, seconds_within
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import OR_STANDARD, refuse_beside_dry_run, say_json, write_told
from appliance.cli.standing import WITHIN, WhenStanding, Within, stand_or_exit
from appliance.features.policy_tools.audit_only import (
    EnforcedAlreadyError,
    EnforcedText,
    EnforceError,
    enforced_text,
)
from appliance.features.policy_tools.learn import Observation, needed_rights
from appliance.features.policy_tools.live_verbs import say_loaded
from appliance.features.policy_tools.policy_input import (
    RecordedPeriod,
    body_in_force,
    context_of,
    live_now,
    recorded_period,
    usage_error,
)
from appliance.features.policy_tools.policy_verbs import compiled_with
from appliance.policy.actions import BadWordError
from appliance.policy.live_rights import Ending, LiveRight, endings
from appliance.policy.model import Request
from appliance.policy.policy import Policy
from appliance.policy.rights import Right, decide_right
from appliance.policy.sections import PARAMETERS
from rosmop.tool.terminal import printable, refusal, say

_MAX_SHOWN = 20


class WouldDeny(msgspec.Struct, frozen=True):
    """A request that passed, and that the enforced policy denies; `count`: how often."""

    host: str
    caller_id: str
    category: str
    resource: str
    count: int
    reason: str


class _Comparison(NamedTuple):
    """The recorded requests that the enforced policy denies, the rights of running nodes that it ends, and the numbers
    that were compared.
    """

    denied: list[WouldDeny]
    ended: list[Ending]
    requests: int
    rights: int


@speaks
def enforce(
    appliance: Appliance,
    sections: Annotated[
        list[str] | None,
        typer.Argument(metavar="SECTION", help="Sections such as Publishers (default: all)"),
    ] = None,
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only list what would have been denied")] = False,
    since: Annotated[
        str,
        typer.Option(
            "--since",
            help="Compare with the requests from this time on: 7d (ago), 14:03, a date, or RFC 3339",
        ),
    ] = "7d",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help=f"File for the changed policy; replaced if it exists; {OR_STANDARD}"
        ),
    ] = None,
    confirm_within: ConfirmWithin = None,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
) -> None:
    """Enforce sections of the policy in force that are `audit-only`, after a comparison with the recorded requests.

    The comparison is printed, and prevents nothing: first use --dry-run, which changes nothing and has exit status 1
    if a recorded request would have been denied, or a right of a running node would end.

    The rights of running nodes are compared too, because the record of a right may be older than the period. The
    policy file is not changed: a reload brings its text back. Denials that depend on which host has a node name now
    are not compared.

    Example: rosrv policy enforce Publishers --confirm-within 5m
    """
    confirmed = seconds_within(confirm_within, "policy")
    if dry_run:
        refuse_beside_dry_run("rosrv policy", confirm_within=confirmed, when_standing=when_standing)
    body = body_in_force(appliance)
    try:
        change = enforced_text(body.text, sections or ())
    except EnforcedAlreadyError as error:
        if appliance.as_json:
            say_json({"sections": [], "revision": body.revision, "replaced": body.revision})
        else:
            say(f"no change: {error}")
        return
    except EnforceError as error:
        raise refusal([f"rosrv policy: {error}"]) from None
    policy = compiled_with(change.text, body.file, context_of(body))
    period = recorded_period(appliance, since)
    live = live_now(appliance)
    comparison = _compare(policy, period, live)
    _show(appliance, comparison, period, change)
    if output is not None:
        try:
            write_told(output, change.text.encode())
        except OSError as error:
            raise usage_error(f"cannot write {output}: {error.strerror}") from None
    if dry_run:
        raise typer.Exit(1 if comparison.denied or comparison.ended else 0)
    if when_standing and not body.site_keys:
        stand_or_exit(appliance, within, "rosrv policy")
    _load(appliance, body, change, confirmed, written=output)


def _compare(policy: Policy, period: RecordedPeriod, live: list[LiveRight]) -> _Comparison:
    counts: Counter[tuple[Request, str]] = Counter()
    number = 0
    for observation in period.requests():
        number += observation.count
        reason = denial(policy, observation)
        if reason:
            counts[observation.request, reason] += observation.count
    denied = [
        WouldDeny(**request.fields(), count=count, reason=reason)
        for (request, reason), count in counts.most_common()
    ]
    return _Comparison(denied, endings(policy, live), number, len(live))


def denial(policy: Policy, observation: Observation) -> str:
    """Return the reason why the policy denies a recorded request, or an empty text."""
    try:
        requests = list(needed_rights(observation))
    except BadWordError:  # no policy grants it, not even in audit-only mode
        return ""
    for request in requests:
        if request.category in PARAMETERS and request.category not in policy.present:
            continue
        decision = decide_right(policy, Right(request))
        if not decision.allowed and not (decision.asks and observation.asked):
            return decision.reason
    return ""


def _show(appliance: Appliance, found: _Comparison, period: RecordedPeriod, change: EnforcedText) -> None:
    rows, ended = found.denied, found.ended
    start = local_text(period.start, digits=0)
    if appliance.as_json:
        say_json({
            "sections": list(change.sections), "since": start, "removed": period.removed,
            "unnamed": period.unnamed, "would_deny": [msgspec.to_builtins(row) for row in rows],
            "would_end": [asdict(row) for row in ended], "requests": found.requests, "rights": found.rights,
        })  # fmt: skip
        return
    number = sum(row.count for row in rows)
    say(f"would have denied since {start}: {number}", "yellow" if rows else "green")
    for row in rows[:_MAX_SHOWN]:
        say(printable(f"  {row.count}x {row.caller_id or 'a client'}: {row.reason}"), "yellow")
    if len(rows) > _MAX_SHOWN:
        say(f"  and {counted(len(rows) - _MAX_SHOWN, 'more request')}: --json lists all", "yellow")
    if ended:
        say(f"would end {counted(len(ended), 'right')} of nodes that run now", "yellow")
    for end in ended[:_MAX_SHOWN]:
        say(printable(f"  {end.caller_id or 'a client'}: {end.reason}"), "yellow")
    if len(ended) > _MAX_SHOWN:
        say(f"  and {len(ended) - _MAX_SHOWN} more: --json lists all", "yellow")
    compared = f"{counted(found.requests, 'recorded request')}, {counted(found.rights, 'right')} of nodes that run now"
    say(f"compared: {compared}", "" if found.requests else "yellow")
    for note in period.notes(appliance, "compared"):
        say(note, "yellow")


def _load(
    appliance: Appliance,
    known: PolicyInForce,
    change: EnforcedText,
    within: float | None,
    *,
    written: Path | None,
) -> None:
    names = " ".join(f"[{name}]" for name in change.sections)
    if known.site_keys:
        target = str(written) if written is not None else "FILE"
        steps = f"sign it (rosrv sign {target} --key KEY), put it at {known.policy_file}, and run: rosrv policy reload"
        first = "" if written is not None else "write the changed policy with --output FILE, "
        raise refusal([f"rosrv policy: this appliance loads signed policies only: {first}{steps}"])
    body = appliance.ask_or_exit(PolicyLoad(change.text, f"enforces {names}", within, known.revision))
    if appliance.as_json:
        say_json(body)
        return
    say(f"enforces {names}")
    say_loaded(body)
    if written is None:
        say(f"{known.policy_file} still says audit-only: change it before the next reload", "yellow")
    else:
        say(f"before the next reload, {known.policy_file} must have the text of {written}", "yellow")
