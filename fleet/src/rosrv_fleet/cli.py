"""The command `rosrv-fleet`: run the collector, enrol robots, make tokens, search, verify and roll out bundles."""

import errno
import json
import os
import ssl
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import psycopg
import typer

from appliance.audit.log.record_format import printable
from appliance.audit.search.filter_options import FilteredCommand
from appliance.audit.search.query import FilterError
from appliance.base.counted import counted
from appliance.base.timestamps import TimestampError, in_local_zone
from appliance.formats.fleet_membership import Invitation
from rosrv_fleet.bundles.commands import bundle
from rosrv_fleet.collector import Collector, make_collector
from rosrv_fleet.config import LEAST_SILENT_SECONDS, FleetConfigError, load_config
from rosrv_fleet.database import migrate, note_complete
from rosrv_fleet.enrolment import EnrolmentError, Robot, RobotGroup, check_name
from rosrv_fleet.evidence.commands import evidence
from rosrv_fleet.index_commands import report_app, search, who_drove
from rosrv_fleet.indexer import NOT_INDEXABLE, index
from rosrv_fleet.invitations import Invitations
from rosrv_fleet.options import DEFAULT_CONFIG, Config, Json, duration
from rosrv_fleet.output import configure_log, note
from rosrv_fleet.presence import RobotPresence
from rosrv_fleet.receipt_key import ReceiptKeyError, make_receipt_key
from rosrv_fleet.robots import Robots, make_folder
from rosrv_fleet.rollouts.commands import rollout
from rosrv_fleet.search import IndexDownError, SearchTooLongError
from rosrv_fleet.segment_store import SegmentStore
from rosrv_fleet.server import ServerCertificateError, authority_of, make_certificate, serve, url_of
from rosrv_fleet.tokens import FleetRole, OperatorTokens, TokenError
from rosrv_fleet.verification import LogProof, prove

# `rosrv-fleet robot`: invite and enrol robots, renew and remove them.

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
    robots.require(name)
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
    robots.require(name)
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
        for name, appliance in robot.appliances.items():
            sign = presence.last(robot.name, name)
            fields: dict[str, str | None] = {
                "name": robot.name,
                "state": "enrolled" if name in robot.connecting else "removed",
                "group": robot.group,
                "key": appliance.key,
                "certificate": appliance.fingerprint,
                "heard": _utc(sign and sign.at),
                "certificate_ends": _utc(appliance.certificate_ends),
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


app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)
token_app = typer.Typer(no_args_is_help=True, help="Make and remove tokens of operators.")
app.add_typer(robot_app, name="robot")
app.add_typer(token_app, name="token")
app.add_typer(report_app, name="report")
app.command(cls=FilteredCommand)(search)
app.command("who-drove")(who_drove)
app.add_typer(bundle, name="bundle")
app.add_typer(rollout, name="rollout")
app.add_typer(evidence, name="evidence")
_ERRORS = (
    FleetConfigError, ServerCertificateError, EnrolmentError, TokenError, ReceiptKeyError, FilterError, TimestampError,
    SearchTooLongError, IndexDownError, OSError, ssl.SSLError, psycopg.Error,
)  # fmt: skip
_ADVICE = {
    errno.ENOSPC: "; free space on this disk, and run the command again",
    errno.EDQUOT: "; free space on this disk, and run the command again",
    errno.EACCES: "; run this as the collector's user",
    errno.EPERM: "; run this as the collector's user",
}


def main() -> None:
    os.umask(0o077)
    configure_log()
    try:
        app()
    except _ERRORS as error:
        sys.stderr.write(f"rosrv-fleet: {printable(reason_of(error))}\n")
        sys.exit(2)


def reason_of(error: BaseException) -> str:
    if not isinstance(error, OSError) or error.strerror is None or isinstance(error, ssl.SSLError):
        return str(error).strip()
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror}{_ADVICE.get(error.errno or 0, '')}"


@app.command()
def init(
    address: Annotated[
        str | None,
        typer.Option(
            "--address",
            metavar="ADDRESS",
            help="IP address at which robots reach the collector, for its certificate",
        ),
    ] = None,
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Prepare the data folder, the collector's certificate and keys, and the database. Repeating it is harmless.

    A certificate that exists is kept.

    Example: rosrv-fleet init --address 10.0.0.9
    """
    found = load_config(config)
    make_folder(found.data)
    make_folder(found.data / "robots")
    made = make_certificate(found, address)
    typer.echo(f"certificate: {found.certificate} {'was made' if made else 'is kept'}")
    typer.echo(f"public key of receipts: {make_receipt_key(found.data)}")
    with psycopg.connect(found.database) as connection:
        applied = migrate(connection)
    typer.echo(f"database: {counted(len(applied), 'migration')} applied")


@app.command("serve")
def serve_collector(config: Config = DEFAULT_CONFIG) -> None:
    """Run the collector until a signal ends it.

    Example: rosrv-fleet serve --config fleet.yaml
    """
    found = load_config(config)
    if found.silent_seconds < LEAST_SILENT_SECONDS:
        note(
            f"silent_seconds: {found.silent_seconds:g} is too short, so parked robots appear as silent:"
            f" set at least {LEAST_SILENT_SECONDS:g} in {config}"
        )
    serve(make_collector(found))


@token_app.command("add")
def add_token(
    name: Annotated[str, typer.Argument(help="Name of the holder")],
    role: Annotated[FleetRole, typer.Option("--role", help="The rights of the holder")] = FleetRole.VIEWER,
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Make a token and print it once.

    Example: rosrv-fleet token add alice --role viewer
    """
    typer.echo(_tokens(config).add(name, role))


@token_app.command("remove")
def remove_token(
    name: Annotated[str, typer.Argument(help="Name of the holder")], config: Config = DEFAULT_CONFIG
) -> None:
    """Remove a token. It is rejected immediately.

    Example: rosrv-fleet token remove alice
    """
    _tokens(config).remove(name)


@token_app.command("list")
def list_tokens(config: Config = DEFAULT_CONFIG) -> None:
    """List the holders of tokens and their roles.

    Example: rosrv-fleet token list
    """
    for token in _tokens(config).all():
        typer.echo(f"{token.name}  {token.role}")


def _tokens(config: Path) -> OperatorTokens:
    return OperatorTokens(load_config(config).data / "tokens.json")


@app.command()
def verify(
    robot: Annotated[str | None, typer.Argument(help="Name of the robot; default: all")] = None,
    config: Config = DEFAULT_CONFIG,
    *,
    as_json: Json = False,
) -> None:
    """Prove from the stored segments that no record is missing. Exit status: 0 proven, 1 not, 2 wrong use.

    The command needs no database. It reads every segment again: about a second for ten thousand records.

    Example: rosrv-fleet verify arm7
    """
    found = load_config(config)
    robots = Robots(found.data / "robots")
    chosen = list(robots.known().values()) if robot is None else [robots.require(robot)]
    store = SegmentStore(found.data, found.limits.reserve_bytes)
    complete = robot is not None or not robots.unreadable
    for one in chosen:
        proofs = prove(store, one, found.limits.segment_bytes)
        for proof in proofs:
            complete = complete and proof.ok
            _print_proof(proof, as_json=as_json)
        if not proofs:
            note(f"{one.name}: nothing was collected yet")
        if len(proofs) > 1:
            note(
                f"{one.name}: {len(proofs)} logs, each proven for itself; see why a new one began:"
                f" rosrv-fleet search --robot {one.name} --event 'log *'"
            )
    raise typer.Exit(0 if complete else 1)


def _print_proof(proof: LogProof, *, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(msgspec.to_builtins(proof) | {"ok": proof.ok}))
        return
    begins = f" after {proof.begins_after} that retention removed" if proof.begins_after else ""
    typer.echo(
        f"{proof.robot}: log {proof.log}: {counted(proof.records, 'record')} in {counted(proof.segments, 'segment')}"
        f" {'is' if proof.records == 1 else 'are'} proven{begins},"
        f" up to {proof.last}; {proof.missing} are missing"
    )
    if proof.removal:
        typer.echo(f"  {printable(proof.removal)}")
    for finding in proof.findings:
        typer.echo(f"  {printable(finding)}")


@app.command()
def reindex(config: Config = DEFAULT_CONFIG) -> None:
    """Rebuild the index from the stored segments. The collector may run; searches are incomplete until the end.

    Exit status 1 if a segment cannot be indexed or the file of a robot is unreadable; all others are indexed.

    Example: rosrv-fleet reindex
    """
    collector = make_collector(load_config(config))
    with psycopg.connect(collector.config.database) as connection:
        migrate(connection)
        connection.execute("TRUNCATE segment, record, complete")
    collector.database.open()
    try:
        indexed, damaged = _index_all(collector)
        if not damaged:
            with collector.database.writing() as connection:
                note_complete(connection)
    finally:
        collector.database.close()
    note(f"{counted(indexed, 'segment is', 'segments are')} indexed")
    raise typer.Exit(1 if damaged else 0)


def _index_all(collector: Collector) -> tuple[int, int]:
    robots = collector.robots.known().values()
    indexed, damaged = 0, len(collector.robots.unreadable)
    oldest = collector.config.retention.oldest_day(collector.store.time_ns())
    for robot in robots:
        for log in collector.store.logs(robot.name):
            for place in collector.store.segments(robot.name, log):
                try:
                    indexed += index(
                        collector.database,
                        collector.store,
                        place,
                        robot.public_keys,
                        collector.config,
                        oldest=oldest,
                    )
                except NOT_INDEXABLE as error:
                    damaged += 1
                    note(f"{collector.store.path(place)} is not indexed: {printable(str(error).strip())}")
    return indexed, damaged
