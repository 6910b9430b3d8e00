"""`rosrv version`: this version, its interpreter and its packages, as a report of a defect needs them."""

import platform
from importlib.metadata import distributions
from typing import Any

from appliance import __version__
from appliance.cli.output import Json, say, say_json


def version(as_json: Json = False) -> None:
    """Show which version this is, and what it stands on.

    Example: rosrv version --json
    """
    facts = _facts()
    if as_json:
        say_json(facts)
        return
    say(f"rosrv {facts['version']}")
    say(f"Python {facts['python']}, {facts['system']} ({facts['machine']})")


def _facts() -> dict[str, Any]:
    packages = {found.name.lower(): found.version for found in distributions()}
    return {
        "version": __version__,
        "python": platform.python_version(),
        "system": _system(),
        "kernel": platform.release(),
        "machine": platform.machine(),
        "packages": dict(sorted(packages.items())),
    }


def _system() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):  # a system that does not say what it is
        return platform.system()
