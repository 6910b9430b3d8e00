"""The command `rosrv guard manual`."""

from pathlib import Path
from typing import Annotated

import typer

from appliance.channel.admin import StatusWanted
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import OR_STANDARD, say_diff, say_json, usage_error, write_told
from appliance.features.guards.manual import Manual, changes, safety_manual
from appliance.features.guards.requests import GuardSuggestionsWanted, GuardsWanted
from rosmop.tool.terminal import say

_VERB = "rosrv guard manual"


@speaks
def manual(
    appliance: Appliance,
    *,
    out: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help=f"Write the manual to this file; {OR_STANDARD}"),
    ] = None,
    diff: Annotated[
        Path | None,
        typer.Option(
            "--diff", metavar="FILE",
            help="Compare it with an earlier manual: without --output, print only the difference; with it, the new"
            " manual ends with it. Exit status 1 if the contents differ",
        ),
    ] = None,
) -> None:  # fmt: skip
    """Print the safety manual of this robot: guards, values, times to stop, assumptions, what is not protected.

    It is Markdown with a digest, and lines for the signatures of two persons. The same guards, values and topics give
    the same digest. Nothing changes.

    Example: rosrv guard manual --output manual.md --diff manual-of-may.md
    """
    status = appliance.ask_or_exit(StatusWanted())
    guards = appliance.ask_or_exit(GuardsWanted(presets=False))
    advice = appliance.ask_or_exit(GuardSuggestionsWanted())
    made = safety_manual(status.name, guards, advice.unguarded)
    lines = _changes(diff, made) if diff is not None else []
    if appliance.as_json:
        say_json({"digest": made.digest, "manual": made.text(lines), "changes": lines})
    elif out is None and diff is not None:
        say_diff(lines or ["no difference"])
    elif out is None:
        typer.echo(made.text([]), nl=False)
    if out is not None:
        write_told(out, made.text(lines).encode())
        if not appliance.as_json:
            say(f"{out}: the safety manual with the digest {made.digest}")
    if lines:
        raise typer.Exit(1)


def _changes(path: Path, made: Manual) -> list[str]:
    try:
        return changes(path.read_text(encoding="utf-8"), made)
    except OSError as error:
        raise usage_error(f"{path} cannot be read: {error.strerror}", _VERB) from None
    except ValueError as error:  # also bytes that are not text
        raise usage_error(f"{path} is not a safety manual: {error}", _VERB) from None
