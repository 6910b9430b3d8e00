import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance import __version__
from tests.support.nodes import need_ros
from tests.support.requirements import need_program, need_root

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def rosrv() -> Iterator[Path]:
    pipx = need_program("pipx", "pipx")
    subprocess.run(["make", "--silent", "wheel"], cwd=ROOT, check=True, capture_output=True)
    built = ROOT / "dist" / f"rosrv_appliance-{__version__}"
    wheel = next(built.parent.glob(f"{built.name}-cp311-abi3-*.whl"))
    folder = Path(tempfile.mkdtemp(prefix="rosrv-wheel-"))
    folder.chmod(0o755)  # the appliance's processes run as other users
    subprocess.run(
        [pipx, "install", "--python", "/usr/bin/python3",
         f"--pip-args=--only-binary :all: --constraint {built}-constraints.txt", str(wheel)],
        env=os.environ | {"PIPX_HOME": str(folder / "pipx"), "PIPX_BIN_DIR": str(folder / "bin")},
        check=True,
    )  # fmt: skip
    yield folder / "bin/rosrv"
    shutil.rmtree(folder)


def run(rosrv: Path, *arguments: str, folder: Path, seconds: float = 60) -> subprocess.CompletedProcess[str]:
    environment = {
        "PATH": f"{rosrv.parent}:/usr/sbin:/usr/bin:/sbin:/bin",
        "HOME": str(folder),
        "COLUMNS": "200",
    }
    command = [str(rosrv), *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=seconds, check=False
    )


def test_it_reports_its_version_and_packages(rosrv: Path, tmp_path: Path) -> None:
    assert re.fullmatch(r"rosrv \d+\.\d+\.\d+(\.dev\d+)?\n", run(rosrv, "--version", folder=tmp_path).stdout)
    facts = json.loads(run(rosrv, "version", "--json", folder=tmp_path).stdout)
    constraints = ROOT / "dist" / f"rosrv_appliance-{__version__}-constraints.txt"
    locked = dict(line.split("==") for line in constraints.read_text().splitlines())
    del locked["python-iptables"]  # an extra, which is compiled
    installed = {
        re.sub(r"[-_.]+", "-", part["name"]): part["version"]
        for part in facts["parts"]
        if part["kind"] == "python"
    }
    # pipx's own, visible in each of its environments
    for own in {"pip", "setuptools", "wheel", "packaging"} - locked.keys():
        installed.pop(own, None)
    assert installed == locked | {"rosrv-appliance": facts["version"]}
    assert "simulated robot" in run(rosrv, "demo", "--help", folder=tmp_path).stdout


def test_its_selftest_names_a_policy_to_begin_with(rosrv: Path, tmp_path: Path) -> None:
    done = run(rosrv, "selftest", "--json", "--state", str(tmp_path / "none"), folder=tmp_path)
    rows = {row["check"]: row for row in map(json.loads, done.stdout.splitlines())}
    assert rows["policy"]["outcome"] == "warn", done.stdout + done.stderr
    named = rows["policy"]["advice"].rpartition("--policy ")[2]
    assert Path(named).is_relative_to(rosrv.parents[1] / "pipx/venvs")
    assert run(rosrv, "policy", "check", named, folder=tmp_path).returncode == 0


def test_its_demonstration_works(rosrv: Path, tmp_path: Path) -> None:
    need_root()
    need_ros()
    done = run(rosrv, "demo", "--json", "--output", str(tmp_path / "way.svg"), folder=tmp_path, seconds=280)
    assert done.returncode == 0, done.stdout + done.stderr
    assert all(row["good"] for row in map(json.loads, done.stdout.splitlines()))
    assert (tmp_path / "way.svg").read_text().startswith(("<svg", "<?xml"))
