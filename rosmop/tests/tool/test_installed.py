"""`pip install ./rosmop`: the command works where there is no appliance."""

import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from rosbags.rosbag1 import Writer

from rosmop.tests.acting import message
from roswire.standard import standard_definitions

FOLDER = Path(__file__).parents[2]
MONITORS = sorted((FOLDER.parent / "monitors").glob("*.rv"))


def run(*command: object, folder: Path = FOLDER) -> subprocess.CompletedProcess[str]:
    """Run a command."""
    return subprocess.run([*map(str, command)], cwd=folder, capture_output=True, text=True, check=False)


def required(requirements: Iterable[str]) -> set[str]:
    """Return the names of these distributions and of all that they need, without extras."""
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
    """A virtual environment that has the wheel and what it depends on, and nothing else."""
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
    for name in required(line.partition(": ")[2] for line in needs if line.startswith("Requires-Dist: ")):
        files = distribution(name).files or ()
        for top in {file.parts[0] for file in files} - {"..", "__pycache__"}:
            if not (packages / top).exists():
                (packages / top).symlink_to(Path(str(distribution(name).locate_file(top))))
    return folder / "venv"


def test_it_has_all_of_the_language(environment: Path) -> None:
    """Every module but the tests, and the wire format; no appliance and no compiler of WebAssembly."""
    packages = next(environment.glob("lib/python*/site-packages"))
    ours = {path.relative_to(FOLDER) for path in FOLDER.rglob("*.py") if "tests" not in path.parts}
    assert {path.relative_to(packages / "rosmop") for path in (packages / "rosmop").rglob("*.py")} == ours
    for absent in ("appliance", "wasmtime"):
        assert (
            f"No module named '{absent}'"
            in run(environment / "bin/python", "-P", "-c", f"import {absent}").stderr
        )


def test_it_checks_specifications(environment: Path) -> None:
    """What is shipped is right: exit status 0; what is wrong has its place, with exit status 1."""
    done = run(environment / "bin/rosmop", "check", *MONITORS)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{len(MONITORS)} specifications right\n")


def test_errors_name_the_command(environment: Path, tmp_path: Path) -> None:
    """A wrong specification has exit status 1, a missing file 2."""
    (tmp_path / "a.rv").write_text("a() {\n  event e() /t std_msgs/None '{}' { }\n}\n")
    wrong = run(environment / "bin/rosmop", "check", "a.rv", folder=tmp_path)
    assert (wrong.returncode, wrong.stdout.partition(" error")[0]) == (1, "a.rv:2:16:")
    missing = run(environment / "bin/rosmop", "check", "b.rv", folder=tmp_path)
    assert (missing.returncode, missing.stderr) == (
        2,
        "rosmop: cannot read b.rv: No such file or directory\n",
    )
    unproved = run(environment / "bin/rosmop", "check", "a.rv", "--prove", folder=tmp_path)
    assert "pip install 'rosmop[prove]'" in unproved.stderr


def test_recordings_go_through_monitors(environment: Path, tmp_path: Path) -> None:
    """The monitor is interpreted; what is learnt is right and says what recordings exercise."""
    definitions = standard_definitions()
    with Writer(tmp_path / "a.bag") as writer:
        text, digest = definitions.full_text("std_msgs/Int32"), definitions.md5sum("std_msgs/Int32")
        numbers = writer.add_connection("/n", "std_msgs/msg/Int32", msgdef=text, md5sum=digest)
        for second in range(100):
            writer.write(numbers, (1000 + second) * 10**9, message("std_msgs/Int32", data=second))
    (tmp_path / "a.rv").write_text(
        "a() {\n  event e(int x) /n std_msgs/Int32 '{data:x}' { if (x > 97) return; }\n}\n"
    )

    def rosmop(*arguments: str) -> str:
        done = run(environment / "bin/rosmop", *arguments, folder=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    *lines, total = rosmop("run", "a.rv", "--bag", "a.bag", "--output", "b.bag").splitlines()
    assert len(lines) == 2
    assert total == "100 messages: 98 passed, 0 changed, 2 dropped; 0 verdicts, 0 faults"
    assert rosmop("run", "a.rv", "--bag", "b.bag").startswith("98 messages: 98 passed")
    assert rosmop("coverage", "a.rv", "--bag", "a.bag").endswith("exercised: 100.0 %\n")
    rosmop("learn", "--bag", "a.bag", "--out", "learnt.rv")
    assert "right" in rosmop("check", "learnt.rv")
