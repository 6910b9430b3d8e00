"""The `rosrv` command: one app, one module for each verb."""

import sys
import traceback

import typer

from appliance.cli import audit, config, demo, monitor, policy, policy_running, protect, status, token, up
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
app.add_typer(monitor.app, name="monitor")
app.add_typer(config.app, name="config")
app.add_typer(token.app, name="token")


def main() -> None:
    """Entry point of the command: errors are words, never a traceback."""
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


if __name__ == "__main__":
    main()
