"""The `rosrv` command: one app, one module for each verb."""

import sys

import typer

from appliance.cli import audit, config, demo, policy, up
from appliance.config_sources import ConfigError
from appliance.supervisor.errors import StartError

app = typer.Typer(
    name="rosrv",
    help="A network-security appliance for ROS 1 robots.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command()(up.up)
app.command()(demo.demo)
app.add_typer(audit.app, name="audit")
app.add_typer(policy.app, name="policy")
app.add_typer(config.app, name="config")


def main() -> None:
    """Entry point of the command: errors are words, never a traceback."""
    try:
        app()
    except (ConfigError, StartError) as error:
        sys.stderr.write(f"rosrv: {error}\n")
        sys.exit(1)


if __name__ == "__main__":
    main()
