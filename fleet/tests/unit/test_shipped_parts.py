import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from rosrv_fleet.config import Limits

from tests.support.sources import ROOT

SHIPPED = set(re.findall(r'"appliance/(\w+)"', (ROOT / "fleet/pyproject.toml").read_text()))
TESTS = ROOT / "fleet" / "tests"


@pytest.mark.nightly
def test_the_collector_imports_only_what_is_shipped_with_it() -> None:
    program = "import rosrv_fleet.cli, sys; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT / "fleet" / "src",
    )
    loaded = {name.split(".")[1] for name in done.stdout.split() if name.startswith("appliance.")}
    assert loaded <= SHIPPED
    assert loaded >= {"audit", "signing"}
    assert not {"rosmop", "roswire"} & set(done.stdout.split())


def test_the_image_has_the_folders_of_the_wheel() -> None:
    copied = set(re.findall(r"^COPY appliance/(\w+) ", (ROOT / "fleet/Dockerfile").read_text(), re.MULTILINE))
    assert copied == SHIPPED


def test_the_database_of_the_containers_has_locks_for_searches_of_five_years() -> None:
    text = (ROOT / "fleet" / "postgres" / "postgresql.conf").read_text()
    locks, connections = (
        int(re.findall(rf"^{name} = (\d+)", text, re.MULTILINE)[0])
        for name in ("max_locks_per_transaction", "max_connections")
    )
    assert locks * connections >= Limits().searches * 12 * 5 * 366


def test_the_tests_import_only_what_is_shipped() -> None:
    """Also through the support of the checkout. `system` is left out: it runs only where the appliance is installed."""
    waiting = [ROOT / "conftest.py", *TESTS.glob("*.py"), *TESTS.glob("unit/*.py")]
    seen: set[Path] = set()
    wrong: list[str] = []
    while waiting:
        file = waiting.pop()
        if file in seen or not file.exists():
            continue
        seen.add(file)
        for name in imported(file.read_text(encoding="utf-8")):
            match name.split("."):
                case ["tests", *_] | ["fleet", "tests", *_] | ["rosmop", "tests", *_]:
                    waiting.append(ROOT.joinpath(*name.split(".")).with_suffix(".py"))
                case ["appliance", part, *_] if part not in SHIPPED:
                    wrong.append(f"{file.relative_to(ROOT)} imports {name}")
                case ["rosmop" | "roswire", *_]:
                    wrong.append(f"{file.relative_to(ROOT)} imports {name}")
    assert not wrong
    assert {ROOT / "tests" / "support" / name for name in ("waiting.py", "virtual_clock.py")} <= seen


def imported(text: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (
                name for one in node.names for name in (f"{node.module}", f"{node.module}.{one.name}")
            )
