"""The checkout that is built from: where it is, which commit, when that was made."""

import json
import subprocess
from datetime import UTC, datetime
from pathlib import Path

from appliance import __version__

ROOT = Path(__file__).parents[1]


def time_of_commit() -> int:
    """When the newest commit was made, in seconds since the epoch: the time in all that is built from it."""
    return int(_git("log", "-1", "--format=%ct"))


def revision() -> str:
    """The newest commit, and whether files differ from it."""
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return _git("rev-parse", "HEAD") + ("-changed" if changed else "")


def facts(kind: str, architecture: str, commit: str, moment: int, **more: str) -> str:
    """What `rosrv version --json` says of the build, as the text of build.json."""
    built = {"kind": kind, "version": __version__, "architecture": architecture, "commit": commit}
    built["moment"] = datetime.fromtimestamp(moment, UTC).isoformat().replace("+00:00", "Z")
    return json.dumps(built | more, indent=2) + "\n"


def _git(*arguments: str) -> str:
    # Root may build somebody else's checkout.
    command = ["git", "-c", f"safe.directory={ROOT}", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
