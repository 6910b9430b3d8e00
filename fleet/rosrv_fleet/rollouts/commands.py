"""`rosrv-fleet rollout`: start, watch, stop and revert rollouts over the collector's REST."""

import ssl
from pathlib import Path
from typing import Annotated, Any

import httpx
import typer

from appliance.audit.record_format import printable
from appliance.base.input_files import read_given
from rosrv_fleet.output import say, say_json

rollout = typer.Typer(
    help="Bring a signed bundle to the robots of a group, ring by ring.", no_args_is_help=True
)

Url = Annotated[
    str, typer.Option("--collector", envvar="ROSRV_FLEET_COLLECTOR", metavar="URL", help="https://HOST:PORT")
]
Authority = Annotated[
    Path | None,
    typer.Option("--ca", envvar="ROSRV_FLEET_CA", metavar="FILE", help="Authority of its certificate"),
]
Token = Annotated[
    Path,
    typer.Option("--token-file", envvar="ROSRV_FLEET_TOKEN_FILE", metavar="FILE", help="Your access token"),
]
Place = Annotated[str, typer.Argument(metavar="SITE/GROUP")]
Json = Annotated[bool, typer.Option("--json", help="Machine-readable output")]
_NO_TOKEN = Path("token")
_NOT_FOUND = 404


@rollout.command()
def start(
    bundle: Annotated[str, typer.Argument(metavar="BUNDLE", help="SITE/GROUP/VERSION.tar")],
    collector: Url,
    ca: Authority = None,
    token_file: Token = _NO_TOKEN,
    *,
    share: Annotated[float, typer.Option(help="Share of a ring that must have it in force")] = 0.95,
    tolerance: Annotated[float, typer.Option(help="Share of a ring that may be unhealthy")] = 0.05,
    healthy: Annotated[float, typer.Option(help="Seconds that a ring must stay healthy")] = 600.0,
) -> None:
    """Begin a rollout; the rings are those that were signed with the bundle.

    Example: rosrv-fleet rollout start site-a/arms/13.tar --healthy 900
    """
    gates = {"share": share, "tolerance": tolerance, "healthy_seconds": healthy}
    _show(_asked("POST", "", collector, ca, token_file, {"bundle": bundle, "gates": gates}))


@rollout.command()
def status(
    collector: Url, ca: Authority = None, token_file: Token = _NO_TOKEN, as_json: Json = False
) -> None:
    """Show the last rollout of each group. Exit status 1 if one has stopped or nothing can be published.

    Example: rosrv-fleet rollout status
    """
    body = _asked("GET", "", collector, ca, token_file)
    if as_json:
        say_json(body)
    else:
        if body["trouble"]:
            say(f"! {body['trouble']}")
        for group in body["groups"]:
            _show(group)
    states = [(group["rollout"] or {}).get("state") for group in body["groups"]]
    raise typer.Exit(int(bool(body["trouble"]) or "stopped" in states))


@rollout.command()
def stop(place: Place, collector: Url, ca: Authority = None, token_file: Token = _NO_TOKEN) -> None:
    """Stop a running rollout: no further robot gets the bundle; those that have it keep it.

    Example: rosrv-fleet rollout stop site-a/arms
    """
    _show(_asked("POST", f"/{place}/stop", collector, ca, token_file))


@rollout.command()
def revert(place: Place, collector: Url, ca: Authority = None, token_file: Token = _NO_TOKEN) -> None:
    """Give all robots of a group the bundle from before the last rollout; it must still be signed.

    Example: rosrv-fleet rollout revert site-a/arms
    """
    _show(_asked("POST", f"/{place}/revert", collector, ca, token_file))


def _asked(  # noqa: PLR0917  a request and its connection
    method: str, path: str, url: str, ca: Path | None, token_file: Path, body: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return the collector's answer; print an error and exit with status 1 if there is none."""
    try:
        token = read_given(token_file, 4096).decode().strip()
        answer = httpx.request(
            method,
            f"{url.rstrip('/')}/v1/rollouts{path}",
            json=body,
            headers={"Authorization": f"Bearer {token}"},
            verify=ssl.create_default_context(cafile=ca),
            timeout=60.0,
            trust_env=False,
        )
        answer.raise_for_status()
        return dict(answer.json())
    except httpx.HTTPStatusError as error:
        reason = f"{error.response.status_code}: {error.response.text[:1000]}"
        if error.response.status_code == _NOT_FOUND:
            reason += "; without the section `bundles` of its configuration, a collector has no rollouts"
    except (httpx.HTTPError, OSError, ValueError) as error:
        reason = str(error)
    typer.echo(f"rosrv-fleet rollout: {printable(reason)}", err=True)
    raise typer.Exit(1)


def _show(group: dict[str, Any]) -> None:
    shown = group["rollout"]
    place = f"{group['site']}/{group['group']}"
    if shown is None:
        say(f"{place}: {group['robots_known']} robots, no rollout")
        return
    say(f"{place}: {shown['bundle']} {shown['state']}: {shown['why']}")
    for ring in shown["rings"]:
        state = "open" if ring["open"] else "not open"
        say(
            f"  {ring['name']} ({state}): {ring['in_force']} of {ring['robots']} in force,"
            f" {ring['refused']} refused, {ring['unhealthy']} unhealthy"
        )
