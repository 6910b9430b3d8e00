"""Report changes of the monitors in force, for `rosrv monitor` and `rosrv guard`."""

from collections.abc import Mapping

from appliance.base.counted import counted
from appliance.channel.answers.monitor_answers import Replacement
from appliance.cli.commit_confirm import say_deadline
from appliance.cli.output import moment
from rosmop.tool.terminal import say


def say_replaced(body: Replacement, enforce: str = "rosrv monitor enforce") -> None:
    for warning in body.warnings:
        say(warning, "yellow")
    parts = [
        f"{word} {', '.join(files)}"
        for word, files in (("added", body.added), ("changed", body.changed), ("removed", body.removed))
        if files
    ]
    what = "; ".join(parts) or "no difference"
    say(f"revision {body.revision} of the specifications is in force (was {body.replaced}): {what}")
    if body.moved:
        names = ", ".join(body.moved)
        say(f"{names} started in the initial state in another relay process", "yellow")
    if body.warnings:
        say(counted(len(body.warnings), "warning"), "yellow")
    say_deadline(body.confirm_by, "monitor")
    for word, idle, command in (
        ("disabled", body.disabled, "rosrv monitor enable"),
        ("in shadow mode", body.shadow, enforce),
    ):
        if idle:
            say(f"{word}: {', '.join(idle)}; {command} {' '.join(idle)}", "yellow")
    say_held(body.held)


def say_shadow_deadline(confirm_by: float | None) -> None:
    if confirm_by is not None:
        say(f"back to shadow mode at {moment(confirm_by)} unless you run: rosrv monitor confirm", "yellow")


def say_held(held: Mapping[str, str]) -> None:
    for name, why in held.items():
        because = why or "its relay process was restarted"
        say(f"{name} holds its topics: {because}; when it is safe: rosrv monitor resume {name}", "red")
