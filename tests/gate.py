"""Run the gate of products (`python -m tests.gate rosmop fleet`), or its cases with real nodes (`… real`).

A product whose files are those of its last green run is not tested again, except with CI or TESTS_EXAMPLES set.
"""

import hashlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.nightly import TABLE, every_file
from tests.support.sources import ROOT

# The tests of every product run with these files. The stamp is of the interpreter and of the installed packages.
_COMMON = (
    "*conftest.py", "appliance/base", "appliance/network", "tests/support", "tests/*.py", "tests/l*", "Makefile",
    "*.toml", "*.lock", "packages*",
)  # fmt: skip
_STAMP = ".venv/.setup-stamp"


def digest(files: Sequence[str], root: Path = ROOT) -> str:
    """Return a digest of files as they are, committed or not; an empty one outside of a clone."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *files, *_COMMON]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    found = hashlib.sha256()
    for name in sorted({*listed.stdout.split("\0"), _STAMP} - {""}):
        path = root / name
        content = path.read_bytes() if path.is_file() else None  # it is removed, but not yet from the index
        link = path.readlink() if path.is_symlink() else None
        found.update(repr((name, link, content is not None and path.stat().st_mode, content)).encode())
    return "" if listed.returncode else found.hexdigest()


def main(products: Sequence[str]) -> int:
    rows = TABLE["products"] | {"real": {**TABLE["products"]["appliance"], "gate": _real_files()}}
    before = {name: digest(rows[name]["files"]) for name in products}
    green = {name: ROOT / "build" / "green" / name for name in products}
    if not os.environ.keys() & {"CI", "TESTS_EXAMPLES"}:
        for name in [name for name in products if before[name] and _text(green[name]) == before[name]]:
            print(f"gate: {name} is not run again, as its files have not changed ({green[name]})", flush=True)
            products = [other for other in products if other != name]
    marks = "real" if products == ["real"] else "not nightly and not real"
    gates = [gate for name in products for gate in rows[name]["gate"]]
    command = [sys.executable, "-m", "pytest", "-c", "pyproject.toml", "--rootdir=.", "-m", marks, *gates]
    command += ["-n", str(len(os.sched_getaffinity(0))), "--dist", "loadfile", "--no-loadscope-reorder"]
    command += ["--quiet", "--durations=10"]
    status = subprocess.run(command, cwd=ROOT, check=False).returncode if gates else 0
    for name in products if status == 0 else ():
        green[name].parent.mkdir(parents=True, exist_ok=True)
        unchanged = digest(rows[name]["files"]) == before[name]  # no file was edited while the tests ran
        green[name].write_text(before[name] if unchanged else "")
    return status


def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8") if file.is_file() else ""


def _real_files() -> list[str]:
    """Return the files with tests marked `real`, without the container, which `make smoke` runs."""
    return [file for file in every_file() if "mark.real" in _text(ROOT / file) and "/smoke/" not in file]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
