"""`rosrv-fleet robot`: invite and enrol robots, renew and remove them."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance.base.timestamps import in_local_zone
from appliance.formats.fleet_membership import Invitation
from rosrv_fleet.config import load_config
from rosrv_fleet.enrolment import Robot, RobotGroup, check_name
from rosrv_fleet.invitations import Invitations
from rosrv_fleet.options import DEFAULT_CONFIG, Config, Json, duration
from rosrv_fleet.presence import RobotPresence
from rosrv_fleet.receipt_key import make_receipt_key
from rosrv_fleet.robots import Robots
from rosrv_fleet.server_certificate import authority_of, url_of

robot_app = typer.Typer(no_args_is_help=True, help="Enrol robots, renew and remove them.")
Name = Annotated[str, typer.Argument(help="Name of the robot")]
InGroup = Annotated[str, typer.Option("--group", metavar="SITE/GROUP", help="Its robot group, for bundles")]
OfPair = Annotated[
    str,
    typer.Option("--appliance", metavar="NAME", help="One appliance of a robot with a standby, such as b"),
]
_WITHIN = duration("1s", "30d")
Certificate = Annotated[
    Path, typer.Option("--certificate", metavar="FILE", help="The robot's client certificate (PEM)")
]


@robot_app.command("invite")
def invite_robots(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Names of the robots")],
    group: InGroup = "",
    within: Annotated[
        float,
        typer.Option(
            "--within",
            parser=_WITHIN,
            metavar="DURATION",
            show_default="24h",
            help="The longest wait until the robots join: 30m, 24h or 7d",
        ),
    ] = 86_400.0,
    appliance: OfPair = "",
    *,
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Print an invitation for each robot, one a line. A robot uses it once: `rosrv fleet join FILE`.

    A newer invitation replaces an earlier one. For an enrolled robot, a join replaces its certificate; without --group
    it keeps its group. The standby of a robot is invited with --appliance, and joins as the same robot.

    Example: rosrv-fleet robot invite arm7 --group site-a/arms > arm7.json
    """
    found = load_config(config)
    if group:
        RobotGroup.parse(group)
    for name in (*names, *([appliance] if appliance else [])):
        check_name(name)
    collector, authority = url_of(found), authority_of(found.certificate)
    receipt_key = make_receipt_key(found.data).read_text(encoding="ascii")
    invitations = Invitations(found.data / "invitations")
    enrolled = Robots(found.data / "robots").known()
    for name in names:
        own = group or (enrolled[name].group if name in enrolled else "")
        pending, token = invitations.add(name, group, within, appliance)
        invitation = Invitation(
            robot=name, group=own, collector=collector, authority=authority, receipt_key=receipt_key, token=token,
            expires=pending.expires,
        )  # fmt: skip
        typer.echo(msgspec.json.encode(invitation).decode())


@robot_app.command("add")
def add_robot(
    name: Name,
    key: Annotated[Path, typer.Option("--key", metavar="FILE", help="The robot's control/audit.pub (PEM)")],
    certificate: Certificate,
    group: InGroup = "",
    *,
    appliance: OfPair = "",
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Enrol a robot: pin the key of its audit log, its client certificate and its group. No restart is needed.

    A robot without a group gets no bundles. With --appliance, enrol the standby of an enrolled robot.

    Example: rosrv-fleet robot add arm7 --key arm7-audit.pub --certificate arm7.pem --group site-a/arms
    """
    robots, _invitations = _robots(config)
    robot = robots.add(name, key.read_bytes(), certificate.read_bytes(), group, appliance)
    own = robot.appliances[appliance or robot.appliance]
    typer.echo(f"{robot.name} is enrolled: log key {own.key}, certificate SHA-256 {own.fingerprint}")


@robot_app.command("group")
def move_robot(
    name: Name,
    group: Annotated[str, typer.Argument(metavar="SITE/GROUP", help="Its robot group, for bundles")],
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Move a robot to a group: from then on it gets the bundles of this group only, and counts in its rollouts.

    Example: rosrv-fleet robot group arm7 site-a/arms
    """
    robots, _invitations = _robots(config)
    robot = robots.move(name, group)
    typer.echo(f"{robot.name} is in {robot.group}")


@robot_app.command("renew")
def renew_robot(
    name: Name, certificate: Certificate, appliance: OfPair = "", config: Config = DEFAULT_CONFIG
) -> None:
    """Replace a robot's client certificate. The earlier certificate and an invitation are rejected from now on.

    Example: rosrv-fleet robot renew arm7 --certificate arm7-2027.pem
    """
    robots, invitations = _robots(config)
    robots.named(name)
    invitations.withdraw(name)  # first: otherwise the robot could join in between
    robot = robots.renew(name, certificate.read_bytes(), appliance)
    own = robot.appliances[appliance or robot.appliance]
    typer.echo(f"{robot.name}: certificate SHA-256 {own.fingerprint}")


@robot_app.command("remove")
def remove_robot(name: Name, appliance: OfPair = "", config: Config = DEFAULT_CONFIG) -> None:
    """Reject a robot and its invitation from now on. Its segments stay and are still verified.

    With --appliance, reject one appliance of a robot with a standby, for example because its machine was replaced.

    Example: rosrv-fleet robot remove arm7
    """
    robots, invitations = _robots(config)
    robots.named(name)
    invitations.withdraw(name)  # first: otherwise the robot could join in between
    robots.remove(name, appliance)
    typer.echo(f"{name}{f' ({appliance})' if appliance else ''} may connect no more; its segments stay")


@robot_app.command("list")
def list_robots(config: Config = DEFAULT_CONFIG, *, as_json: Json = False) -> None:
    """List the robots: group, log key, certificate, when the robot was last heard, and when its certificate ends.

    A robot with a standby has a line for each appliance. Exit status 1 if the file of a robot is unreadable.

    Example: rosrv-fleet robot list
    """
    robots, _invitations = _robots(config)
    presence = RobotPresence(robots.folder.parent / "heard")
    for robot in robots.known().values():
        for name, one in robot.appliances.items():
            sign = presence.last(robot.name, name)
            fields: dict[str, str | None] = {
                "name": robot.name,
                "state": "enrolled" if name in robot.connecting else "removed",
                "group": robot.group,
                "key": one.key,
                "certificate": one.fingerprint,
                "heard": _utc(sign and sign.at),
                "certificate_ends": _utc(one.certificate_ends),
                "appliance": name,
            }
            typer.echo(json.dumps(fields) if as_json else _robot_line(robot, fields))
    raise typer.Exit(1 if robots.unreadable else 0)


def _robot_line(robot: Robot, fields: dict[str, str | None]) -> str:
    words = [fields[name] or "-" for name in ("name", "state", "group", "key", "certificate")]
    words += [f"heard {fields['heard'] or 'never'}", f"valid until {fields['certificate_ends']}"]
    return in_local_zone("  ".join([*words, *([f"appliance {fields['appliance']}"] if robot.others else [])]))


def _utc(seconds: float | None) -> str | None:
    return None if seconds is None else f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%SZ}"


def _robots(config: Path) -> tuple[Robots, Invitations]:
    data = load_config(config).data
    return Robots(data / "robots"), Invitations(data / "invitations")
