"""The command `rosrv policy unused`."""

from typing import Annotated

import typer

from appliance.base.counted import counted
from appliance.base.timestamps import local_text
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import say_json
from appliance.features.policy_tools.policy_input import live_now, recorded_period
from appliance.features.policy_tools.policy_verbs import compile_or_exit
from appliance.features.policy_tools.rule_uses import RuleUse, RuleUses
from rosmop.tool.terminal import printable, say


@speaks_with("One JSON object for each rule that grants something")
def list_unused(
    appliance: Appliance,
    *,
    since: Annotated[
        str, typer.Option("--since", help="From this time: 30d (ago), 14:03, a date, or RFC 3339")
    ] = "30d",
    everything: Annotated[bool, typer.Option("--all", help="Also list the used rules")] = False,
) -> None:
    """List the rules of the policy in force, and the hosts in them, that were not used since the time of --since, and
    the rights whose date has passed.

    Registrations of running nodes count as uses. A rule or host is `unknown` instead of `unused` if a use may be
    among removed records, or among records that only count a host's requests.

    Example: rosrv policy unused --since 30d
    """
    period = recorded_period(appliance, since)
    uses = RuleUses(compile_or_exit(appliance, None, None, None))
    for observation in period.requests():
        uses.add(observation)
    uses.add_live(live_now(appliance))
    rows = list(uses.rules(period.unnamed, removed=period.removed))
    for row in rows:
        if everything or row.state != "used" or row.ended:
            _say_row(row, as_json=appliance.as_json)
    if not appliance.as_json:
        unused, unknown = (sum(row.state == state for row in rows) for state in ("unused", "unknown"))
        start = local_text(period.start, digits=0)
        name = "names hosts that did not use it" if unused == 1 else "name hosts that did not use them"
        text = f"{unused} of {counted(len(rows), 'rule')} {name} since {start}"
        say(f"{text}; {unknown} unknown", "yellow" if unused else "green")
        if period.removed:
            say("the log's records before that time are removed", "yellow")
        for host, count in sorted(period.unnamed.items()):
            who = "several hosts" if host == "*" else appliance.host_in_words(host)
            say(f"{counted(count, 'request')} of {who} only counted in the log, without names", "yellow")


def _say_row(row: RuleUse, *, as_json: bool) -> None:
    if as_json:
        rule = row.rule
        place = {"section": rule.section, "key": rule.key, "file": rule.file, "line": rule.line}
        hosts = {"unused_hosts": list(row.unused), "unknown_hosts": list(row.unknown)}
        say_json({**place, "state": row.state, "used": row.used, **hosts, "ended_hosts": list(row.ended)})
        return
    if row.ended:
        say(printable(f"{row.rule}: ended: {', '.join(row.ended)}"), "yellow")
    if row.state == "used":
        say(printable(f"{row.rule}: used {row.used}x"))
    if row.unused:
        by = " by " + " ".join(row.unused) if row.used else ""
        say(printable(f"{row.rule}: unused{by}"), "yellow")
    if row.unknown:
        say(printable(f"{row.rule}: unknown for {' '.join(row.unknown)}"))
