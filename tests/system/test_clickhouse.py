"""The plan for larger fleets: with `fleet/clickhouse/schema.sql`, ClickHouse finds what PostgreSQL finds.

ClickHouse has its own environment (540 MB): nothing else needs it.
"""

import os
import subprocess
import sys
from pathlib import Path

from tests.support.requirements import need_root

ROOT = Path(__file__).parents[2]
LOCK = ROOT / "benchmarks/fleet_clickhouse.lock"
UV = Path(sys.executable).with_name("uv")


def test_both_indexes_give_the_same_answers(tmp_path: Path) -> None:
    need_root()  # PostgreSQL runs as another user
    packages = str(tmp_path / "packages")
    install = [
        str(UV), "pip", "install", "--quiet", "--target", packages, "--no-deps", "--require-hashes", "-r", str(LOCK),
    ]  # fmt: skip
    subprocess.run(install, check=True, timeout=240)
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.fleet_clickhouse", "--rows", "40000", "--rounds", "3"],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": packages},
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("\n0 answers differ\n")
