"""The command `rosrv-fleet`: run the collector, enrol robots, make tokens, search, verify and roll out bundles."""

import errno
import json
import os
import ssl
import sys
from pathlib import Path
from typing import Annotated

import msgspec
import psycopg
import typer

from appliance.audit.log.record_format import printable
from appliance.audit.search.filter_options import FilteredCommand
from appliance.audit.search.query import FilterError
from appliance.base.counted import counted
from appliance.base.timestamps import TimestampError
from rosrv_fleet.bundles.commands import bundle
from rosrv_fleet.collector import Collector, make_collector
from rosrv_fleet.config import LEAST_SILENT_SECONDS, FleetConfigError, load_config
from rosrv_fleet.database import migrate
from rosrv_fleet.enrolment import EnrolmentError
from rosrv_fleet.evidence.commands import evidence
from rosrv_fleet.index_commands import report_app, search, who_drove
from rosrv_fleet.indexer import NOT_INDEXABLE, index
from rosrv_fleet.options import DEFAULT_CONFIG, Config, Json
from rosrv_fleet.output import configure_log
from rosrv_fleet.receipt_key import ReceiptKeyError, make_receipt_key
from rosrv_fleet.robot_commands import robot_app
from rosrv_fleet.robots import Robots, make_folder
from rosrv_fleet.rollouts.commands import rollout
from rosrv_fleet.search import IndexDownError, SearchTooLongError
from rosrv_fleet.segment_store import SegmentStore
from rosrv_fleet.server import serve
from rosrv_fleet.server_certificate import ServerCertificateError, make_certificate
from rosrv_fleet.tokens import FleetRole, OperatorTokens, TokenError
from rosrv_fleet.verification import LogProof, prove

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
        _note(
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


def _note(text: str) -> None:
    typer.echo(f"rosrv-fleet: {text}", err=True)


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
    chosen = list(robots.known().values()) if robot is None else [robots.named(robot)]
    store = SegmentStore(found.data, found.limits.reserve_bytes)
    complete = robot is not None or not robots.unreadable
    for one in chosen:
        proofs = prove(store, one, found.limits.segment_bytes)
        for proof in proofs:
            complete = complete and proof.ok
            _print_proof(proof, as_json=as_json)
        if not proofs:
            _note(f"{one.name}: nothing was collected yet")
        if len(proofs) > 1:
            _note(
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
        connection.execute("TRUNCATE segment, record")
    collector.database.open()
    try:
        indexed, damaged = _index_all(collector)
    finally:
        collector.database.close()
    _note(f"{counted(indexed, 'segment is', 'segments are')} indexed")
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
                    _note(f"{collector.store.path(place)} is not indexed: {printable(str(error).strip())}")
    return indexed, damaged
