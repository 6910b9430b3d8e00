"""The commands `rosrv drive status|assign|free|ask`."""

import ipaddress
from collections.abc import Callable
from typing import Annotated

import typer

from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import say_json, say_row
from appliance.features.authority.requests import (
    DriveAsk,
    DriveGive,
    DriveStatus,
    DriveTake,
    GroupState,
    GroupStates,
)
from rosmop.tool.terminal import say

_GroupName = Annotated[
    str,
    typer.Argument(metavar="GROUP", help="A command group in [Authority] of the policy", show_default=False),
]
_Host = Annotated[
    str,
    typer.Option(
        "--host", metavar="HOST", help="An address, or the name of one host: robot, host:NAME, door:NAME"
    ),
]


_NO_GROUPS = (
    "the policy has no section [Authority], so each host commands what [Publishers] and [Clients] grant it"
)


@speaks
def status(
    appliance: Appliance,
    group: Annotated[str | None, typer.Argument(metavar="GROUP", help="Only this group")] = None,
) -> None:
    """Show the holder of each group, and the hosts that wait for it. Exit status 1 if there is no such group.

    Example: rosrv drive status
    """
    body = appliance.ask_or_exit(DriveStatus())
    rows = [one for one in body.groups if group in (None, one.group)]
    if appliance.as_json:
        say_json(GroupStates(rows))
        raise typer.Exit(0 if rows else 1)
    if not rows:
        names = ", ".join(one.group for one in body.groups)
        say(f"[Authority] has no group {group!r}; its groups: {names}" if names else _NO_GROUPS)
        raise typer.Exit(1)
    for row in rows:
        _show(appliance, row)


@speaks
def assign(appliance: Appliance, group: _GroupName, *, host: _Host) -> None:
    """Assign a group to a host that may take it, or that may override its holder.

    Not for a group with ranks: its highest node that moves drives.

    Example: rosrv drive assign base --host host:ocu-1
    """
    _show(appliance, appliance.answer_or_exit(DriveTake(group, host)))


@speaks
def free(
    appliance: Appliance,
    group: _GroupName,
    *,
    to: Annotated[
        str,
        typer.Option(
            "--to", metavar="HOST", help="Assign the group to this host, even if the host may only ask"
        ),
    ] = "",
) -> None:
    """Take a group from its holder. The first host that waits and may take the group gets it.

    In a group with ranks, all hosts may drive again, for example after the driver's connection was lost. This is
    refused while the driver moves.

    Example: rosrv drive free base
    """
    _show(appliance, appliance.answer_or_exit(DriveGive(group, to)))


@speaks
def ask(appliance: Appliance, group: _GroupName, *, host: _Host) -> None:
    """Let a host wait for a group, for one minute. A host that may take the group gets it as soon as it is free.

    Not for a group with ranks: its highest node that moves drives.

    Example: rosrv drive ask base --host host:agent-1
    """
    _show(appliance, appliance.answer_or_exit(DriveAsk(group, host)))


def _show(appliance: Appliance, state: GroupState) -> None:
    shown = appliance.host_in_words
    if state.ranks:
        since = "" if state.held_seconds is None else f" for {state.held_seconds:g} s"
        why = " ".join(shown(word) if _is_address(word) else word for word in state.why.split(" "))
        say_row([f"{state.group}: {state.standing}{since}: {why}"])
        say_row([f"  rank: {' > '.join(state.ranks)}"])
        _show_not_carried(shown, state)
        return
    held = (
        f"held by {shown(state.holder)}, {state.left_seconds:g} s left without a message"
        if state.holder
        else "free"
    )
    parts = [f"{state.group}: {held}"]
    if state.waiting:
        parts = [f"{parts[0]};", f"waiting: {', '.join(map(shown, state.waiting))}"]
    say_row(parts, gap=" ")
    _show_not_carried(shown, state)


def _show_not_carried(shown: Callable[[str], str], group: GroupState) -> None:
    for one in group.not_carried:
        nodes = f"{one.nodes[0]}{f' and {len(one.nodes) - 1} more' if len(one.nodes) > 1 else ''}"
        order = f": {one.order}" if one.order else ""
        say_row([f"  not carried: messages of {shown(one.host)} ({nodes}) to {one.topic}{order}"])


def _is_address(word: str) -> bool:
    try:
        ipaddress.ip_address(word)
    except ValueError:
        return False
    return True
