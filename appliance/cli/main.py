"""The `rosrv` command: one app, one module for each verb."""

import sys
import traceback

import typer

from appliance.cli import (
    audit,
    config,
    demo,
    host,
    monitor,
    monitor_running,
    policy,
    policy_running,
    protect,
    status,
    token,
    up,
)
from appliance.config_sources import ConfigError
from appliance.network.namespaces import NetworkError
from appliance.supervisor.errors import StartError

app = typer.Typer(
    name="rosrv",
    help="A network-security appliance for ROS 1 robots.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command()(up.up)
app.command()(status.status)
app.command()(demo.demo)
app.command()(protect.protect)
app.add_typer(audit.app, name="audit")
for verb in (
    policy_running.reload,
    policy_running.rollback,
    policy_running.confirm,
    policy_running.revisions,
):
    policy.app.command()(verb)
app.add_typer(policy.app, name="policy")
monitor.app.command(name="list")(monitor_running.list_monitors)
for order in (
    monitor_running.enable,
    monitor_running.disable,
    monitor_running.load,
    monitor_running.remove,
    monitor_running.reload,
    monitor_running.resume,
):
    monitor.app.command()(order)
monitor.app.command(name="rvstate", hidden=True)(monitor_running.rv_state)
app.add_typer(monitor.app, name="monitor")
app.add_typer(config.app, name="config")
app.add_typer(host.app, name="host")
app.add_typer(token.app, name="token")


def main() -> None:
    """Entry point of the command: errors are words, never a traceback."""
    sys.argv[1:] = _without_old_flags(sys.argv[1:])
    try:
        app()
    except (ConfigError, StartError, NetworkError) as error:
        sys.stderr.write(f"rosrv: {error}\n")
        sys.exit(1)
    except Exception as error:  # noqa: BLE001  the last resort; what it was and where is still told
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{last.filename}:{last.lineno}"
        sys.stderr.write(
            f"rosrv: a defect of rosrv, please report it: {type(error).__name__}: {error} ({where})\n"
        )
        sys.exit(70)


_OLD_FLAGS = {"-list": "list", "-rvstate": "rvstate", "-enable": "enable", "-disable": "disable"}
"""ROSRV's own flags, and the verbs of `rosrv monitor` that took their place."""


def _without_old_flags(arguments: list[str]) -> list[str]:
    """`rosrv -enable M…` is `rosrv monitor enable M…`."""
    verb = _OLD_FLAGS.get(arguments[0]) if arguments else None
    return arguments if verb is None else ["monitor", verb, *arguments[1:]]


if __name__ == "__main__":
    main()
