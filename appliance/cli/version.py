"""`rosrv version`: this version, its build, interpreter and packages, as a report of a defect needs them."""

import json
import platform
from importlib.metadata import distributions
from typing import Any

from appliance import __version__
from appliance.cli.output import Json, say, say_json
from appliance.cli.shipped import SHIPPED


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
    build = SHIPPED / "build.json"
    return {
        "version": __version__,
        # Of a package or an image: from which commit. A checkout and a wheel have none.
        "build": json.loads(build.read_text()) if build.exists() else None,
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
