"""The commands `rosrv host block|unblock|blocks`."""

import shlex
from typing import Annotated

import typer

from appliance.base import clock
from appliance.base.counted import counted
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.output import moment, say_json, say_row
from appliance.features.blocks.requests import (
    BlockedHost,
    BlockEnded,
    HostBlock,
    HostBlocked,
    HostBlocks,
    HostUnblock,
)
from rosmop.tool.terminal import say

_MINUTES_FROM = 600
_Address = Annotated[
    str,
    typer.Argument(
        help="An address, or the name of an enrolled host or a group of one host", show_default=False
    ),
]


@speaks
def block(
    running: Appliance,
    address: _Address,
    *,
    time: Annotated[
        str | None,
        typer.Option(
            "--for", help="End the block after this time: 30s, 10m, 1h, 2d (default: it has no end)"
        ),
    ] = None,
    note: Annotated[str, typer.Option(help="The reason, for other operators")] = "",
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Block even the robot's own host, a host with most of the registrations, or the host that you use",
        ),
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only show what the block would end")] = False,
) -> None:
    """Block a host at once: refuse its calls and new connections, and end its registrations, connections, sessions
    and tunnel.

    The block survives restarts. It ends after the given time, or with `rosrv host unblock`. Another end or note
    replaces the block; the same block changes nothing.

    Example: rosrv host block 10.0.0.7 --for 1h --note "strange traffic"
    """
    seconds = None if time is None else bounded_span("--for", time, "1s", "365d", "rosrv host")
    body = running.answer_or_exit(HostBlock(address, seconds, note, force, dry_run))
    end = (
        f"until {moment(body.until)}"
        if body.until is not None
        else f"until `rosrv host unblock {body.address}`"
    )
    if not dry_run and body.replaced is not None and body.replaced.since == body.since:
        say(f"no change: {_named(body, running)} is blocked {end}")
        return
    if dry_run:
        say(f"{_named(body, running)} would be blocked {end}; it would lose {_in_words(body.ended)}")
    else:
        say(f"{_named(body, running)} is blocked {end}; it lost {_in_words(body.ended)}")
    for use in body.ended.uses:
        say(f"{'would end' if dry_run else 'ended'}: {use}")
    if body.replaced is not None:
        say(f"this replaces the block by {_whose(body.replaced)}")
    if not dry_run:
        say(f"undo: {_undo(body)}")
    for other in body.other_addresses:
        say(
            f"! the same machine also has the address {other}, which is not blocked: rosrv host block {other}",
            "yellow",
        )


@speaks
def unblock(running: Appliance, address: _Address) -> None:
    """Lift the block of a host. Its withdrawn registrations return as far as the policy allows.

    Example: rosrv host unblock 10.0.0.7
    """
    body = running.answer_or_exit(HostUnblock(address))
    say(f"{_named(body, running)} is no longer blocked; {counted(body.restored, 'registration')} returned")


@speaks
def list_blocks(running: Appliance) -> None:
    """List the blocked hosts: address, start and end of the block, operator, note.

    Example: rosrv host blocks
    """
    blocks = running.ask_or_exit(HostBlocks()).blocks
    for row in blocks:
        if running.as_json:
            say_json(row)
        else:
            end = "no end" if row.until is None else f"until {moment(row.until)}"
            say_row(
                [
                    f"{_named(row, running):<37}",
                    f"since {moment(row.since)}",
                    f"{end:<23}",
                    f"by {row.who}{_note(row)}",
                ]
            )
    if not blocks and not running.as_json:
        say("no host is blocked")


def _named(row: BlockedHost, running: Appliance) -> str:
    return f"{row.name} ({row.address})" if row.name else running.host_in_words(row.address)


def _whose(row: BlockedHost) -> str:
    end = "without an end" if row.until is None else f"until {moment(row.until)}"
    return f"{row.who}, {end}{_note(row)}"


def _undo(body: HostBlocked) -> str:
    """Return the command that brings back the state before a block, with the present rest of the time."""
    earlier = body.replaced
    if earlier is None:
        return f"rosrv host unblock {body.address}"
    seconds = None if earlier.until is None else max(1, round(earlier.until - clock.wall()))
    time = (
        ""
        if seconds is None
        else f" --for {seconds}s"
        if seconds < _MINUTES_FROM
        else f" --for {round(seconds / 60)}m"
    )
    note = f" --note {shlex.quote(earlier.note)}" if earlier.note else ""
    return f"rosrv host block {body.address}{time}{note}"


def _note(row: BlockedHost) -> str:
    return f": {row.note}" if row.note else ""


def _in_words(ended: BlockEnded) -> str:
    parts = (
        counted(ended.publications, "publication"),
        counted(ended.subscriptions, "subscription"),
        counted(ended.services, "service"),
        counted(ended.parameters, "parameter subscription"),
        counted(ended.connections, "connection"),
    )
    return (
        ", ".join(part for part in parts if not part.startswith("0 "))
        or "nothing: nothing of it was registered"
    )
