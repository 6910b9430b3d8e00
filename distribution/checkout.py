"""The path, commit and time of the checkout from which releases are built."""

import json
from datetime import UTC, datetime
from pathlib import Path

from appliance import __version__
from distribution.programs import run

ROOT = Path(__file__).parents[1]


def time_of_commit() -> int:
    """Return the time of the newest commit in seconds since the epoch, which all files of a build get.

    Raise `BuildError`, as `revision` does.
    """
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
    failed = f"build in a clone of the repository, not in {ROOT}"
    return run(
        command, missing="sudo apt-get install git", failed=failed, cwd=ROOT, capture_output=True
    ).strip()
