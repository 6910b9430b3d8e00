import re
import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

pytestmark = pytest.mark.nightly

FOLDER = Path(__file__).parents[2]
UNUSED = {"apsw", "numpy"}
"""`rosbags` requires them, but nothing here loads them: the appliance's package and image are without them."""
MONITORS = sorted((FOLDER.parent / "monitors").glob("*.rv"))


def run(*command: object, folder: Path = FOLDER) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*map(str, command)], cwd=folder, capture_output=True, text=True, check=False)


def required(requirements: Iterable[str]) -> set[str]:
    found: set[str] = set()
    waiting = list(requirements)
    while waiting:
        one = Requirement(waiting.pop())
        if one.name not in found and (one.marker is None or one.marker.evaluate({"extra": ""})):
            found.add(one.name)
            waiting += distribution(one.name).requires or ()
    return found


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("installed")
    built = run(sys.executable, "-P", "-m", "hatchling", "build", "--target", "wheel", "--directory", folder)
    assert built.returncode == 0, built.stderr
    run(sys.executable, "-P", "-m", "venv", "--without-pip", folder / "venv")
    python = folder / "venv/bin/python"
    wheel = next(folder.glob("*.whl"))
    pip = [sys.executable, "-P", "-m", "pip", "--python", python]
    done = run(*pip, "install", "--no-deps", "--no-index", "--disable-pip-version-check", wheel)
    assert done.returncode == 0, done.stderr
    packages = Path(
        run(python, "-P", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").stdout.strip()
    )
    needs = (packages / f"{wheel.name.rpartition('-py3')[0]}.dist-info/METADATA").read_text().splitlines()
    names = required(line.partition(": ")[2] for line in needs if line.startswith("Requires-Dist: "))
    assert names > UNUSED
    for name in names - UNUSED:
        files = distribution(name).files or ()
        for top in {file.parts[0] for file in files} - {"..", "__pycache__"}:
            if not (packages / top).exists():
                (packages / top).symlink_to(Path(str(distribution(name).locate_file(top))))
    return folder / "venv"


def test_the_wheel_is_complete(environment: Path) -> None:
    packages = next(environment.glob("lib/python*/site-packages"))
    ours = {path.relative_to(FOLDER) for path in FOLDER.rglob("*.py") if "tests" not in path.parts}
    assert {path.relative_to(packages / "rosmop") for path in (packages / "rosmop").rglob("*.py")} == ours
    for absent in ("appliance", "wasmtime", *UNUSED):
        done = run(environment / "bin/python", "-P", "-c", f"import {absent}")
        assert f"No module named '{absent}'" in done.stderr
    version = re.search(r'^__version__ = "(.+)"', (FOLDER.parent / "appliance/__init__.py").read_text(), re.M)
    assert version is not None
    assert (packages / f"rosmop-{version[1]}.dist-info").is_dir()


def test_shipped_specifications_are_valid(environment: Path) -> None:
    done = run(environment / "bin/rosmop", "check", *MONITORS)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{len(MONITORS)} specifications OK\n")


def test_errors_name_the_command(environment: Path, tmp_path: Path) -> None:
    (tmp_path / "a.rv").write_text("a() {\n  event e() /t std_msgs/None '{}' { }\n}\n")
    wrong = run(environment / "bin/rosmop", "check", "a.rv", folder=tmp_path)
    assert (wrong.returncode, wrong.stdout.partition(" error")[0]) == (1, "a.rv:2:16:")
    missing = run(environment / "bin/rosmop", "check", "b.rv", folder=tmp_path)
    said = "rosmop: cannot read b.rv: No such file or directory\n"
    assert (missing.returncode, missing.stderr) == (2, said)
    unproved = run(environment / "bin/rosmop", "check", "a.rv", "--prove", folder=tmp_path)
    assert "pip install z3-solver" in unproved.stderr


def test_why_slow_says_that_nothing_is_compiled_here(environment: Path, tmp_path: Path) -> None:
    (tmp_path / "a.rv").write_text(
        "a() { event e(int n) /n std_msgs/UInt8 '{data:n}' { if (n == 2) return; } }"
    )
    slow = run(environment / "bin/rosmop", "check", "a.rv", "--why-slow", folder=tmp_path)
    assert slow.stdout.splitlines()[-1] == (
        "compiled code processes every message; here all are interpreted: wasmtime is not installed"
    )


def test_the_readme_links_to_files() -> None:
    links = re.findall(r"\]\(([^)]+)\)", (FOLDER / "README.md").read_text())
    assert links
    assert [link for link in links if not (FOLDER / link).is_file()] == []


def test_the_readme_shows_real_output(environment: Path, tmp_path: Path) -> None:
    blocks = dict(re.findall(r"```(\w+)\n(.*?)```", (FOLDER / "README.md").read_text(), re.DOTALL))
    (tmp_path / "limit.rv").write_text(blocks["cpp"])
    (tmp_path / "record.py").write_text(blocks["python"])
    made = run(sys.executable, "record.py", folder=tmp_path)  # rosbags needs numpy to encode a message
    assert made.returncode == 0, made.stderr

    def output(command: str, *arguments: str) -> list[str]:
        done = run(environment / "bin" / command, *arguments, folder=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        return [line.rstrip() for line in done.stdout.splitlines()]

    shown = blocks["console"].splitlines()
    commands = [line for line in shown if line.startswith("$ ")]
    assert len(commands) == 4
    assert shown == [part for line in commands for part in (line, *output(*line[2:].split()))]
    assert output("rosmop", "check", "learnt.rv")[0] == "1 specification OK"
    output("rosmop", "run", "limit.rv", "--bag", "drive.bag", "--output", "passed.bag")
    assert output("rosmop", "run", "limit.rv", "--bag", "passed.bag")[0].startswith("98 messages: 98 passed")
