"""The command `rosrv-fleet`: run the collector, enrol robots, make tokens, search, verify, roll out bundles."""

import json
import logging
import os
import ssl
import sys
from pathlib import Path
from typing import Annotated, Any

import msgspec
import psycopg
import structlog
import typer

from appliance.audit.query import Filter, FilterError
from appliance.audit.record_format import printable
from appliance.base.timestamps import TimestampError
from rosrv_fleet.bundles.commands import bundle
from rosrv_fleet.collector import Collector, make_collector
from rosrv_fleet.config import ConfigError, FleetConfig, load_config
from rosrv_fleet.database import migrate
from rosrv_fleet.filtering import searched
from rosrv_fleet.receipt_key import ReceiptKeyError, make_receipt_key
from rosrv_fleet.robots import EnrolmentError, Robots, make_folder
from rosrv_fleet.rollouts.commands import rollout
from rosrv_fleet.search import LARGEST_FLEET_PAGE, IndexDownError, SearchTooLongError, search_fleet
from rosrv_fleet.search_sql import FleetFilter
from rosrv_fleet.segment_store import SegmentStore
from rosrv_fleet.server import serve
from rosrv_fleet.tokens import FleetRole, TokenError, Tokens
from rosrv_fleet.verification import LogProof, prove

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)
robot_app = typer.Typer(no_args_is_help=True, help="Enrol robots, renew and remove them.")
token_app = typer.Typer(no_args_is_help=True, help="Make and remove tokens of operators.")
app.add_typer(robot_app, name="robot")
app.add_typer(token_app, name="token")
app.add_typer(bundle, name="bundle")
app.add_typer(rollout, name="rollout")
_ERRORS = (
    ConfigError, EnrolmentError, TokenError, ReceiptKeyError, FilterError, TimestampError, SearchTooLongError,
    IndexDownError, OSError, ssl.SSLError, psycopg.Error, msgspec.MsgspecError,
)  # fmt: skip
_MOST_WAITING = 1000
Config = Annotated[
    Path, typer.Option("--config", envvar="ROSRV_FLEET_CONFIG", help="The collector's configuration file")
]
_DEFAULT = Path("/etc/rosrv-fleet/fleet.yaml")
Name = Annotated[str, typer.Argument(help="Name of the robot")]
Certificate = Annotated[Path, typer.Option("--certificate", help="The robot's client certificate (PEM)")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object a line (NDJSON)")]


def main() -> None:
    """Run the command. Errors are one line on standard error, with exit status 2."""
    try:
        app()
    except _ERRORS as error:
        sys.stderr.write(f"rosrv-fleet: {printable(str(error).strip())}\n")
        sys.exit(2)


def _loaded(config: Path) -> FleetConfig:
    os.umask(0o077)
    return load_config(config)


@app.command()
def init(config: Config = _DEFAULT) -> None:
    """Prepare the data folder, the key of receipts and the database. Repeating it is harmless.

    Example: rosrv-fleet init --config fleet.yaml
    """
    found = _loaded(config)
    make_folder(found.data)
    make_folder(found.data / "robots")
    public = make_receipt_key(found.data)
    typer.echo(f"copy to each robot, as fleet.receipt_key: {public}")
    with psycopg.connect(found.database) as connection:
        applied = migrate(connection)
    typer.echo(f"database: {len(applied)} migrations applied")


@app.command("serve")
def serve_collector(config: Config = _DEFAULT) -> None:
    """Run the collector until a signal ends it.

    Example: rosrv-fleet serve --config fleet.yaml
    """
    found = _loaded(config)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
    serve(make_collector(found))


@robot_app.command("add")
def add_robot(
    name: Name,
    key: Annotated[Path, typer.Option("--key", help="The robot's control/audit.pub (PEM)")],
    certificate: Certificate,
    config: Config = _DEFAULT,
) -> None:
    """Enrol a robot: pin the key of its audit log and its client certificate. A running collector notices.

    Example: rosrv-fleet robot add arm7 --key arm7-audit.pub --certificate arm7.pem
    """
    robot = _robots(config).add(name, key.read_bytes(), certificate.read_bytes())
    typer.echo(f"{robot.name} is enrolled: log key {robot.key}, certificate SHA-256 {robot.fingerprint}")


@robot_app.command("renew")
def renew_robot(name: Name, certificate: Certificate, config: Config = _DEFAULT) -> None:
    """Replace a robot's client certificate. The earlier one is refused at once.

    Example: rosrv-fleet robot renew arm7 --certificate arm7-2027.pem
    """
    robot = _robots(config).renew(name, certificate.read_bytes())
    typer.echo(f"{robot.name}: certificate SHA-256 {robot.fingerprint}")


@robot_app.command("remove")
def remove_robot(name: Name, config: Config = _DEFAULT) -> None:
    """Refuse a robot from now on. Its segments stay and are still verified.

    Example: rosrv-fleet robot remove arm7
    """
    _robots(config).remove(name)
    typer.echo(f"{name} may connect no more; its segments stay")


@robot_app.command("list")
def list_robots(config: Config = _DEFAULT, *, as_json: Json = False) -> None:
    """List the robots with their certificates.

    Example: rosrv-fleet robot list
    """
    for robot in _robots(config).all().values():
        state = "enrolled" if robot.removed is None else "removed"
        fields = {"name": robot.name, "state": state, "key": robot.key, "certificate": robot.fingerprint}
        typer.echo(json.dumps(fields) if as_json else "  ".join(fields.values()))


def _robots(config: Path) -> Robots:
    return Robots(_loaded(config).data / "robots")


@token_app.command("add")
def add_token(
    name: Annotated[str, typer.Argument(help="Name of the holder")],
    role: Annotated[FleetRole, typer.Option("--role", help="What the holder may do")] = FleetRole.VIEWER,
    config: Config = _DEFAULT,
) -> None:
    """Make a token and print it once.

    Example: rosrv-fleet token add alice --role viewer
    """
    typer.echo(Tokens(_loaded(config).data / "tokens.json").add(name, role))


@token_app.command("remove")
def remove_token(
    name: Annotated[str, typer.Argument(help="Name of the holder")], config: Config = _DEFAULT
) -> None:
    """Remove a token. It is refused at once.

    Example: rosrv-fleet token remove alice
    """
    Tokens(_loaded(config).data / "tokens.json").remove(name)


@token_app.command("list")
def list_tokens(config: Config = _DEFAULT) -> None:
    """List the holders of tokens and their roles.

    Example: rosrv-fleet token list
    """
    for token in Tokens(_loaded(config).data / "tokens.json").all():
        typer.echo(f"{token.name}  {token.role}")


@app.command()
@searched
def search(
    wanted: Filter,
    robot: Annotated[str | None, typer.Option("--robot", help="Name of the robot; a glob")] = None,
    limit: Annotated[
        int, typer.Option("--limit", min=1, max=LARGEST_FLEET_PAGE, help="Largest number of records")
    ] = 100,
    cursor: Annotated[str | None, typer.Option("--cursor", help="Continue where a search ended")] = None,
    config: Config = _DEFAULT,
    *,
    as_json: Json = False,
) -> None:
    """Find records of all robots, newest first.

    Example: rosrv-fleet search --deny --since 1h --topic '/cmd_*' --robot 'arm*'
    """
    collector = make_collector(_loaded(config))
    waiting = len(collector.store.marked("pending", _MOST_WAITING))
    collector.database.open()
    try:
        page = search_fleet(collector.database, FleetFilter(robot, wanted), cursor, limit, waiting)
    finally:
        collector.database.close()
    for record in page.records:
        typer.echo(json.dumps(record, separators=(",", ":")) if as_json else _line(record))
    if page.waiting:
        _note(f"{page.waiting} stored segments are not indexed yet: this search misses them")
    if page.cursor is not None:
        _note(f"more records match: --cursor {page.cursor}, or a larger --limit")


def _line(record: dict[str, Any]) -> str:
    names = ("robot", "time", "severity", "decision", "event", "host", "caller_id", "resource", "reason")
    return "  ".join(printable(str(record[name])) for name in names if record.get(name))


def _note(text: str) -> None:
    typer.echo(f"rosrv-fleet: {text}", err=True)


@app.command()
def verify(
    robot: Annotated[str | None, typer.Argument(help="Name of the robot; default: all")] = None,
    config: Config = _DEFAULT,
    *,
    as_json: Json = False,
) -> None:
    """Prove from the stored segments that no record is missing. Exit status: 0 proven, 1 not, 2 wrong use.

    It needs no database. Every segment is read again, so it takes about a second for ten thousand records.

    Example: rosrv-fleet verify arm7
    """
    found = _loaded(config)
    robots = Robots(found.data / "robots")
    chosen = list(robots.all().values()) if robot is None else [robots.named(robot)]
    store = SegmentStore(found.data, found.limits.reserve_bytes)
    complete = True
    for one in chosen:
        proofs = prove(store, one, found.limits.segment_bytes)
        for proof in proofs:
            complete = complete and proof.ok
            _print_proof(proof, as_json=as_json)
        if not proofs:
            _note(f"{one.name}: nothing was collected yet")
    raise typer.Exit(0 if complete else 1)


def _print_proof(proof: LogProof, *, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(msgspec.to_builtins(proof) | {"ok": proof.ok}))
        return
    begins = f" after {proof.begins_after} that retention removed" if proof.begins_after else ""
    typer.echo(
        f"{proof.robot}: log {proof.log}: {proof.records} records in {proof.segments} segments are proven{begins},"
        f" up to {proof.last}; {proof.missing} are missing"
    )
    for finding in proof.findings:
        typer.echo(f"  {printable(finding)}")


@app.command()
def reindex(config: Config = _DEFAULT) -> None:
    """Rebuild the index from the stored segments. The collector may run; searches are incomplete until the end.

    Example: rosrv-fleet reindex
    """
    collector = make_collector(_loaded(config))
    with psycopg.connect(collector.config.database) as connection:
        migrate(connection)
        connection.execute("TRUNCATE segment, record")
    collector.database.open()
    try:
        _note(f"{_index_all(collector)} segments are indexed")
    finally:
        collector.database.close()


def _index_all(collector: Collector) -> int:
    count = 0
    for robot in collector.robots.all():
        for log in collector.store.logs(robot):
            for place in collector.store.segments(robot, log):
                collector.indexer.index(place)
                count += 1
    return count
