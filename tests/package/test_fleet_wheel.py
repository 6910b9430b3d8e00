import re
import shutil
import subprocess
from pathlib import Path

import pytest

from appliance import __version__
from tests.support.requirements import needs

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    needs(Path("/usr/lib/x86_64-linux-gnu/libpq.so.5").exists(), "libpq5")
    folder = tmp_path_factory.mktemp("fleet")
    lock = (ROOT / "fleet" / "requirements.lock").read_text()
    (folder / "constraints.txt").write_text("\n".join(re.findall(r"^[a-z0-9.-]+==\S+", lock, re.MULTILINE)))
    subprocess.run(["/usr/bin/python3", "-m", "venv", folder / "venv"], check=True)
    options = ("--quiet", "--disable-pip-version-check", "--constraint", str(folder / "constraints.txt"))
    subprocess.run([folder / "venv/bin/pip", "install", *options, "./fleet"], cwd=ROOT, check=True)
    return folder / "venv/bin/rosrv-fleet"


def run(program: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(folder)}
    return subprocess.run(
        [program, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_the_command_runs_without_a_checkout(program: Path, tmp_path: Path) -> None:
    shown = run(program, tmp_path, "--help").stdout
    for verb in ("init", "serve", "robot", "search", "verify", "bundle", "rollout"):
        assert verb in shown
        assert run(program, tmp_path, verb, "--help").returncode == 0
    (tmp_path / "fleet.yaml").write_text("data: data\ndatabase: host=/nonexistent dbname=fleet\n")
    begun = run(program, tmp_path, "init", "--address", "10.0.0.9", "--config", "fleet.yaml")
    assert begun.returncode == 2
    assert "server.pem was made" in begun.stdout
    assert "/nonexistent" in begun.stderr
    assert (
        "https://10.0.0.9:8444"
        in run(program, tmp_path, "robot", "invite", "arm7", "--config", "fleet.yaml").stdout
    )


def test_its_gate_needs_its_own_requirements_only() -> None:
    needs(shutil.which("make"), "make")
    subprocess.run(["make", "--directory", ROOT / "fleet", "--always-make", "test"], check=True)


def test_it_has_the_version_of_the_appliance(program: Path) -> None:
    pip = program.with_name("pip")
    shown = subprocess.run([pip, "show", "rosrv-fleet"], capture_output=True, text=True, check=True).stdout
    assert f"\nVersion: {__version__}\n" in shown
