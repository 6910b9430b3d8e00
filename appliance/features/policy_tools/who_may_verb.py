"""The command `rosrv policy who-may`."""

from collections.abc import Iterator
from ipaddress import IPv4Address
from typing import Annotated

import typer

from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import say_json
from appliance.features.policy_tools.policy_input import Enrolled, Robot, usage_error
from appliance.features.policy_tools.policy_verbs import OptionalFile, compile_or_exit, decision_fields
from appliance.features.policy_tools.who_may import HostAnswer, who_may
from appliance.policy.actions import VERBS, BadWordError, parse_action
from appliance.policy.model import Category, Request
from appliance.policy.rights import needs_node
from rosmop.tool.terminal import say


@speaks
def list_who_may(
    appliance: Appliance,
    action: Annotated[str, typer.Argument(metavar="ACTION", help=f"One of {', '.join(VERBS)}")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Topic, service, parameter, node or call")],
    file: OptionalFile = None,
    *,
    node: Annotated[str, typer.Option(help="Also require the right to this node name")] = "",
    robot: Robot = None,
    enrolled: Enrolled = None,
) -> None:
    """List the hosts that may do something, and the rule for each. Exit status 1 if no host may.

    Example: rosrv policy who-may publish /cmd_vel
    """
    try:
        category, resource = parse_action(f"{action} {name}")
    except BadWordError as error:
        raise usage_error(str(error)) from error
    policy = compile_or_exit(appliance, file, robot, enrolled)
    answers = list(who_may(policy, category, resource, node))
    shown = [answer for answer in answers if answer.decision.rank or answer.near]
    for answer in shown:
        if appliance.as_json:
            say_json(_fields(answer))
        else:
            say(_line(answer), "" if answer.decision.verdict == "allow" else "yellow")
    may = any(answer.decision.rank for answer in answers)
    if not appliance.as_json:
        for line in _notes(category, resource, node, may=may):
            say(line)
        for address, block in policy.blocks.items():
            say(f"whatever the rules say: {address} is {block}", "yellow")
    raise typer.Exit(0 if may else 1)


_ONLY = {
    "deny": "denied",
    "ask": "needs an approval each time (rosrv approve)",
    "would deny": "passes only in audit-only mode",
}


def _line(answer: HostAnswer) -> str:
    hosts = f"{', '.join(answer.names)} ({answer.hosts})" if answer.names else answer.hosts
    if answer.decision.verdict != "allow":
        return f"{hosts}: {_ONLY[answer.decision.verdict]}: {answer.decision.reason}"
    if answer.decision.rule is None:
        return f"{hosts}: {answer.decision.reason}"
    through = ", ".join(answer.through)
    return f"{hosts}: as {through}, by {answer.decision.rule}"


def _notes(category: Category, resource: str, node: str, *, may: bool) -> Iterator[str]:
    if not may:
        yield "no host may"
    elif not node and needs_node(Request(IPv4Address(0), "", category, resource)):
        yield "each also needs a node name that [Nodes] allows: check one with --node /NAME"


def _fields(answer: HostAnswer) -> dict[str, object]:
    return {
        "hosts": answer.hosts,
        "names": list(answer.names),
        "through": list(answer.through),
        **decision_fields(answer.decision),
    }
