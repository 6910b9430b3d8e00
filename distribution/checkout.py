"""The path, commit and time of the checkout from which releases are built."""

import json
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from appliance import __version__

# Run the programs that builds need: git, docker, compilers, and Debian's tools.


class BuildError(Exception):
    """A release cannot be built. The text has the reason and the remedy."""


def run(command: Sequence[str], *, missing: str, failed: str = "its output is above", **options: Any) -> str:
    """Return the output of a program, if `options` of `subprocess.run` capture it, or raise `BuildError`.

    `missing` is the remedy if the program is not installed, `failed` the place of its messages or the remedy.
    """
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, text=True, check=False, **options)
    except FileNotFoundError as error:
        raise BuildError(f"there is no {command[0]}: {missing}") from error
    if done.returncode:
        more = (done.stderr or "").strip().rpartition("\n")[2]
        name = " ".join(word for word in command[:2] if not word.startswith("-"))
        raise BuildError(f"{name} ended with status {done.returncode}: {more + '; ' if more else ''}{failed}")
    return done.stdout or ""


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
