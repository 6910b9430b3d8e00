"""`rosrv-fleet rollout`: start, watch, stop and revert rollouts over the collector's REST."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from appliance.base.counted import counted
from appliance.base.timestamps import local_text
from rosrv_fleet.operator_client import NO_TOKEN, Authority, Token, Url, answer_to
from rosrv_fleet.options import Json, duration
from rosrv_fleet.output import say, say_json

rollout = typer.Typer(
    help="Bring a signed bundle to the robots of a group, ring by ring.", no_args_is_help=True
)

Place = Annotated[str, typer.Argument(metavar="SITE/GROUP", help="The site and the robot group")]
_NO_BUNDLES = "; without the section `bundles` of its configuration, a collector has no rollouts"
_GOOD = ("in force", "no bundle")


@rollout.command()
def start(
    bundle: Annotated[str, typer.Argument(metavar="BUNDLE", help="SITE/GROUP/VERSION.tar")],
    collector: Url,
    ca: Authority = None,
    token_file: Token = NO_TOKEN,
    *,
    share: Annotated[float, typer.Option(help="Share of a ring that must have it in force")] = 0.95,
    tolerance: Annotated[float, typer.Option(help="Share of a ring that may be unhealthy")] = 0.05,
    healthy: Annotated[
        float,
        typer.Option(
            "--healthy",
            parser=duration("0s", "7d"),
            metavar="DURATION",
            show_default="10m",
            help="How long a ring must stay healthy: 90s, 15m",
        ),
    ] = 600.0,
    ring_within: Annotated[
        float,
        typer.Option(
            "--ring-within",
            parser=duration("1s", "30d"),
            metavar="DURATION",
            show_default="1h",
            help="The longest time in which a ring must reach its share: 90m, 2d",
        ),
    ] = 3600.0,
) -> None:
    """Begin a rollout; the rings are those that were signed with the bundle.

    Example: rosrv-fleet rollout start site-a/arms/13.tar --healthy 15m
    """
    gates = {
        "share": share,
        "tolerance": tolerance,
        "healthy_seconds": healthy,
        "ring_seconds": ring_within,
    }
    _show(_ask("POST", "", collector, ca, token_file, {"bundle": bundle, "gates": gates}))


@rollout.command()
def status(collector: Url, ca: Authority = None, token_file: Token = NO_TOKEN, as_json: Json = False) -> None:
    """Show the last rollout of each group. Exit status 1 if one has stopped or nothing can be published.

    Example: rosrv-fleet rollout status
    """
    body = _ask("GET", "", collector, ca, token_file)
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
def stop(place: Place, collector: Url, ca: Authority = None, token_file: Token = NO_TOKEN) -> None:
    """Stop a running rollout: no other robot gets the bundle, and robots that have it keep it.

    Example: rosrv-fleet rollout stop site-a/arms
    """
    _show(_ask("POST", f"/{place}/stop", collector, ca, token_file))


@rollout.command()
def revert(place: Place, collector: Url, ca: Authority = None, token_file: Token = NO_TOKEN) -> None:
    """Give all robots of a group the bundle that preceded the last rollout; it must still be signed.

    Example: rosrv-fleet rollout revert site-a/arms
    """
    _show(_ask("POST", f"/{place}/revert", collector, ca, token_file))


def _ask(  # noqa: PLR0917  a request and its connection
    method: str, path: str, url: str, ca: Path | None, token_file: Path, body: dict[str, Any] | None = None
) -> dict[str, Any]:
    with answer_to(
        method, f"rollouts{path}", url, ca, token_file, not_found=_NO_BUNDLES, json=body
    ) as answer:
        return dict(json.loads(answer.read()))


def _problems(group: dict[str, Any]) -> str:
    found = [f"{count} {kind}" for kind, count in group["conditions"].items() if count and kind not in _GOOD]
    return f": {', '.join(found)}" if found else ""


def _time(seconds: float) -> str:
    return local_text(int(seconds) * 10**9, digits=0).replace("T", " ")


def _show(group: dict[str, Any]) -> None:
    shown = group["rollout"]
    place = f"{group['site']}/{group['group']}"
    if shown is None:
        say(f"{place}: {counted(group['robots_known'], 'robot')}, no rollout{_problems(group)}")
        return
    say(f"{place}: {shown['bundle']} {shown['state']}: {shown['why']}")
    acts = (f"{act['act']} by {act['who']} at {_time(act['at'])}" for act in shown["acts"])
    say(f"  {', '.join(acts)}")
    if _problems(group):
        say(f"  robots{_problems(group)}")
    for ring in shown["rings"]:
        state = "open" if ring["open"] else "not open"
        say(
            f"  {ring['name']} ({state}): {ring['in_force']} of {ring['robots']} in force,"
            f" {ring['refused']} refused, {ring['unhealthy']} unhealthy"
        )
