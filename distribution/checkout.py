"""The path, commit and time of the checkout from which releases are built."""

import json
import subprocess
from datetime import UTC, datetime
from pathlib import Path

from appliance import __version__

ROOT = Path(__file__).parents[1]


def time_of_commit() -> int:
    """Return the time of the newest commit in seconds since the epoch. All files of a build get this time."""
    return int(_git("log", "-1", "--format=%ct"))


def revision() -> str:
    """Return the commit, with the suffix `-changed` if tracked files differ from it."""
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return _git("rev-parse", "HEAD") + ("-changed" if changed else "")


def facts(kind: str, architecture: str, commit: str, moment: int, **more: str) -> str:
    """Return the text of build.json, which `rosrv version --json` prints."""
    built = {"kind": kind, "version": __version__, "architecture": architecture, "commit": commit}
    built["moment"] = datetime.fromtimestamp(moment, UTC).isoformat().replace("+00:00", "Z")
    return json.dumps(built | more, indent=2) + "\n"


def _git(*arguments: str) -> str:
    # Root may build a checkout that belongs to another user.
    command = ["git", "-c", f"safe.directory={ROOT}", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
