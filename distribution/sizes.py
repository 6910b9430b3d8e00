"""Print the lines of Python of each district, and what came since a commit: `python -m distribution.sizes [COMMIT]`.

Lines that moved as a block are counted apart. Files that git does not know do not count.
"""

import subprocess
import sys
from collections import Counter

from distribution.checkout import ROOT

DISTRICTS = {
    "rosmop/tests": "tests of the language", "fleet/tests": "tests of the fleet", "lab/tests": "tests of the lab",
    "appliance/features": "features", "appliance": "core", "rosmop": "language", "roswire": "roswire", "fleet": "fleet",
    "distribution": "distribution", "lab": "lab", "proofs": "lab", "tests": "tests of the appliance",
}  # fmt: skip
_COLOURS = {"old": "red", "new": "green", "oldMoved": "blue", "newMoved": "cyan"}
_MEANINGS = {"\x1b[31m-": "removed", "\x1b[32m+": "added", "\x1b[34m-": "moved out", "\x1b[36m+": "moved in"}


def district(path: str) -> str:
    return next((name for folder, name in DISTRICTS.items() if path.startswith(f"{folder}/")), "the rest")


def _git(*arguments: str) -> str:
    run = subprocess.run(["git", "-C", str(ROOT), *arguments], check=True, capture_output=True)
    return run.stdout.decode(errors="replace")


def sizes(commit: str) -> dict[str, Counter[str]]:
    """Return the lines of each district, and how many were added, removed and moved since the commit."""
    found = {name: Counter[str]() for name in (*DISTRICTS.values(), "the rest")}
    for path in _git("ls-files", "*.py").splitlines():
        if (ROOT / path).is_file():
            found[district(path)]["lines"] += (ROOT / path).read_bytes().count(b"\n")
    colours = [text for name, colour in _COLOURS.items() for text in ("-c", f"color.diff.{name}={colour}")]
    moved = ("--color=always", "--color-moved=blocks", "--color-moved-ws=ignore-all-space")
    diff = _git(
        *colours, "-c", "color.diff.meta=normal", "diff", "-U0", "--no-renames", *moved, commit, "--", "*.py"
    )
    where = ""
    for line in diff.split("\n"):
        if line.startswith("diff --git "):
            where = district(line.rpartition(" b/")[2])
        elif line[:6] in _MEANINGS:
            found[where][_MEANINGS[line[:6]]] += 1
    return {name: counted for name, counted in found.items() if counted}


if __name__ == "__main__":
    columns = ("lines", "added", "removed", "moved in", "moved out")
    rows = [
        ("", columns),
        *(
            (name, [f"{size[key]:,}" for key in columns])
            for name, size in sizes(*(sys.argv[1:] or ["HEAD"])).items()
        ),
    ]
    sys.stdout.writelines(f"{name:24}" + "".join(f"{cell:>11}" for cell in row) + "\n" for name, row in rows)
