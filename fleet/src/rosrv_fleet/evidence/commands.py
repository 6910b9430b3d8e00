"""`rosrv-fleet evidence`: add, list and get bundles over the collector's REST, and remove one on its machine."""

import errno
import hashlib
import json
import os
from pathlib import Path
from typing import Annotated, Any

import typer

from appliance.audit.log.record_format import rfc3339
from appliance.base.atomic_files import name_to_make
from appliance.base.counted import counted
from appliance.base.input_files import open_given
from rosrv_fleet.config import load_config
from rosrv_fleet.evidence.store import EvidenceStore
from rosrv_fleet.operator_client import NO_TOKEN, Authority, Token, Url, answer_to
from rosrv_fleet.options import DEFAULT_CONFIG, Config, Json
from rosrv_fleet.output import say, say_json

evidence = typer.Typer(help="Add evidence bundles of robots, list and get them.", no_args_is_help=True)
_SECONDS = 7200.0  # the collector answers after the verification, which waits for its turn
_CREATED = 201


@evidence.command()
def add(
    file: Annotated[Path, typer.Argument(help="Bundle written by `rosrv evidence export`")],
    robot: Annotated[str, typer.Option("--robot", help="Name of the robot that made it")],
    collector: Url,
    ca: Authority = None,
    token_file: Token = NO_TOKEN,
) -> None:
    """Store a robot's evidence bundle. The collector verifies it with the robot's enrolled key and collected segments.

    Example: rosrv-fleet evidence add incident.zip --robot arm7
    """
    connection = (collector, ca, token_file)
    with (
        open_given(file) as bundle,
        answer_to(
            "POST", "evidence", *connection, seconds=_SECONDS, params={"robot": robot}, content=bundle
        ) as answer,
    ):
        found = json.loads(answer.read())
    stored = "is stored" if answer.status_code == _CREATED else "was stored before; nothing has changed"
    say(f"{found['id']} {stored}: evidence of {robot}, {_content(found)}")
    for fact in found["unproven"]:
        say(f"unproven  {fact}")


@evidence.command("list")
def list_evidence(
    collector: Url,
    ca: Authority = None,
    token_file: Token = NO_TOKEN,
    robot: Annotated[str, typer.Option("--robot", help="Name of the robot; default: all")] = "",
    *,
    as_json: Json = False,
) -> None:
    """List the evidence bundles, latest first.

    Example: rosrv-fleet evidence list --robot arm7
    """
    with answer_to("GET", "evidence", collector, ca, token_file, params={"robot": robot}) as answer:
        stored = json.loads(answer.read())
    for one in stored:
        if as_json:
            say_json(one)
        else:
            say(
                f"{one['id']}  {one['robot']}  {_content(one)}, added by {one['by']} at {rfc3339(one['added'])}"
            )


def _content(found: dict[str, Any]) -> str:
    recording = f", recording {found['recording']}" if found["recording"] else ""
    return (
        f"{counted(found['records'], 'record')} from {rfc3339(found['since'])} to {rfc3339(found['until'])}{recording},"
        f" {found['bytes']} bytes,"
        f" {found['collected']} of {counted(found['checkpoints'], 'checkpoint is', 'checkpoints are')} collected"
    )


@evidence.command()
def get(
    evidence_id: Annotated[str, typer.Argument(metavar="ID", help="Its SHA-256, as in `evidence list`")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="File (ZIP), must not exist")
    ],
    collector: Url,
    ca: Authority = None,
    token_file: Token = NO_TOKEN,
) -> None:
    """Write a bundle to a file. Verify it with `rosrv evidence verify`, or with Python and openssl alone.

    Example: rosrv-fleet evidence get 5d0f… --output incident.zip
    """
    if os.path.lexists(output):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(output))
    part, digest = name_to_make(output), hashlib.sha256()
    try:
        with (
            answer_to("GET", f"evidence/{evidence_id}", collector, ca, token_file) as answer,
            part.open("xb") as file,
        ):
            for piece in answer.iter_bytes():
                digest.update(piece)
                file.write(piece)
            if digest.hexdigest() != evidence_id:
                raise ValueError("the collector sent a different file: get it again, and check its disk")
        part.rename(output)
    finally:
        part.unlink(missing_ok=True)
    say(f"{output}: {output.stat().st_size} bytes; verify it: rosrv evidence verify {output} --key audit.pub")


@evidence.command()
def remove(
    evidence_id: Annotated[str, typer.Argument(metavar="ID", help="Its SHA-256, as in `evidence list`")],
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Remove an evidence bundle from the collector, on the collector's machine.

    Example: rosrv-fleet evidence remove 5d0f…
    """
    removed = EvidenceStore(load_config(config).data / "evidence").remove(evidence_id)
    if removed is None:
        raise FileNotFoundError(
            errno.ENOENT, "no evidence bundle has this ID, see rosrv-fleet evidence list", evidence_id
        )
    say(f"{removed.id} is removed: evidence of {removed.robot}, {removed.bytes} bytes")
