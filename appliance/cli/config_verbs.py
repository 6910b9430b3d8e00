"""`rosrv config check|show`: validate and print the configuration."""

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer
import yaml

from appliance.configuration.config_sources import ConfigError, json_schema, plain, resolve

_CheckedFile = Annotated[
    Path | None, typer.Argument(readable=False, metavar="FILE", help="The same as --config FILE")
]
_File = Annotated[
    Path | None,
    typer.Option(
        "--config", readable=False, help="Configuration file (default: ROSRV_CONFIG, else ./appliance.yaml)"
    ),
]
_Json = Annotated[bool, typer.Option("--json", help="Machine-readable output")]


def check(file: _CheckedFile = None, config: _File = None, as_json: _Json = False) -> None:
    """Report every error in the configuration file and the environment variables. Exit status: 0 valid, 1 errors.

    Example: rosrv config check appliance.yaml
    """
    try:
        resolve(file or config, os.environ, {})
    except ConfigError as error:
        if not as_json:
            raise
        for mistake in error.mistakes:
            _print(json.dumps({"place": mistake.place, "text": mistake.text}))
        raise typer.Exit(1) from error
    if not as_json:
        _print("The configuration is valid.")


def show(
    config: _File = None,
    as_json: _Json = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON schema of the file instead")
    ] = False,
) -> None:
    """Print every key with its effective value, defaults included.

    Example: rosrv config show --schema
    """
    if schema:
        _print(json.dumps(json_schema(), indent=2))
        return
    settings = plain(resolve(config, os.environ, {}))
    _print(json.dumps(settings) if as_json else yaml.safe_dump(settings, sort_keys=False).rstrip())


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")
