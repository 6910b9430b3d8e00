"""The commands `rosrv door add|list|ticket|remove`."""

from typing import Annotated

import typer

from appliance.base.counted import counted
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.output import moment, say_json, say_row
from appliance.features.doors.requests import (
    ConnectedClient,
    DoorAdd,
    DoorRemove,
    DoorState,
    DoorsWanted,
    DoorTicket,
)
from rosmop.tool.terminal import say

_Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the door", show_default=False)]


@speaks
def add(
    appliance: Appliance,
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="Name of the door, `door:NAME` in the policy", show_default=False
        ),
    ],
    *,
    port: Annotated[
        int | None,
        typer.Option(help="Port for an agent, which needs no ticket (1024 to 65535)", show_default=False),
    ] = None,
    source: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="ADDRESS",
            help="Address or network of the agent (default: any)",
            show_default=False,
        ),
    ] = "",
) -> None:
    """Add a door for one person, program or agent. Its rights are those of the host `door:NAME` in the policy.

    Without --port, only tickets open the door. With --port, any program that connects to the port from the address of
    --from has the rights of the door; without --from, from any address.

    Example: rosrv door add agent-1 --port 9091 --from 10.0.0.7
    """
    body = appliance.answer_or_exit(DoorAdd(name, port, source))
    say(f"{body.name} has the address {body.address}, and the node {body.node}")
    if body.port is None:
        say(f"Next: rosrv door ticket {body.name} --for 8h")
    elif not body.source:
        say(
            f"! every host that reaches port {body.port} has the rights of door:{body.name}: add --from",
            "yellow",
        )
    if body.warning:
        say(f"! {body.warning}", "yellow")
    say(f"It may do what the policy lets door:{body.name} do: rosrv policy explain --host door:{body.name}")


@speaks
def list_doors(appliance: Appliance) -> None:
    """List the doors: address, tickets, why a door does not serve, and its clients' traffic of the last minute.

    Example: rosrv door list
    """
    doors = appliance.ask_or_exit(DoorsWanted()).doors
    for row in doors:
        if appliance.as_json:
            say_json(row)
        else:
            connections = counted(row.connections, "connection")
            say_row([f"{row.name:<20}", f"{row.address:<15}", f"{_entry(row)}, {connections}"])
            for one in row.tickets:
                say(f"    ticket {one.id} until {moment(one.expires)}, by {one.who}")
                if one.warning:
                    say(f"    ! {one.warning}", "yellow")
            for client in row.clients:
                say_row([f"    {_client(client)}"])
            if row.connections > len(row.clients) > 0:
                say(f"    and {row.connections - len(row.clients)} more")
            for problem in filter(None, (row.trouble, row.warning)):
                say(f"    ! {problem}", "yellow")
    if appliance.as_json:
        return
    if doors:
        say("Rights of a door: rosrv policy explain --host door:NAME")
    else:
        say("no doors; add one: rosrv door add NAME")


@speaks
def ticket(
    appliance: Appliance,
    name: _Name,
    *,
    time: Annotated[str, typer.Option("--for", help="How long it is valid: 30m, 8h; at most 30d")] = "8h",
) -> None:
    """Make a ticket: a URL with which a person's browser or Foxglove opens the door. It is shown once.

    Anyone who has the URL has the rights of the door until the ticket ends.

    Example: rosrv door ticket alice --for 8h
    """
    seconds = bounded_span("--for", time, "1s", "30d", "rosrv door")
    body = appliance.answer_or_exit(DoorTicket(name, seconds))
    say(f"wss://ADDRESS:8443{body.path}")
    typer.echo(
        f"rosrv: ticket {body.id} is valid until {moment(body.expires)}; put the appliance's address and REST port in"
        " place of ADDRESS:8443",
        err=True,
    )


@speaks
def remove(appliance: Appliance, name: _Name) -> None:
    """Remove a door. Its connections and tickets end at once; its address stays reserved for its name.

    Example: rosrv door remove agent-1
    """
    body = appliance.answer_or_exit(DoorRemove(name))
    port = "" if body.port is None else f" --port {body.port}"
    source = f" --from {body.source}" if body.source else ""
    say(f"{body.name} ({body.address}) is removed; undo: rosrv door add {body.name}{port}{source}")


def _client(one: ConnectedClient) -> str:
    origin = f" by {one.who}" if one.who else ""
    refused = f", {counted(one.refused, 'refusal')}" if one.refused else ""
    return (
        f"{one.address}{origin} since {moment(one.since)}, {one.protocol}: {one.received} received, {one.sent} sent"
        f"{refused} in the last minute"
    )


def _entry(row: DoorState) -> str:
    if row.port is None:
        return "by ticket"
    return f"port {row.port} from {row.source or 'anywhere'}"
