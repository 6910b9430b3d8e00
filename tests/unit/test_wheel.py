import os
import re
import subprocess
import sys
import tomllib
import zipfile
from email import message_from_string
from email.message import Message
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.tags import sys_tags

from appliance import __version__
from distribution.extension import IN_PLACE

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RUNS = [Requirement(one) for one in (*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["iptables"])]
LANGUAGE = tomllib.loads((ROOT / "rosmop" / "pyproject.toml").read_text())["project"]
LANGUAGE_RUNS = map(Requirement, (*LANGUAGE["dependencies"], *LANGUAGE["optional-dependencies"]["fast"]))
LOCKED = dict(re.findall(r"^([a-z0-9-]+)==(\S+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return next(folder.glob("*.whl"))


def metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return message_from_string(archive.read(name).decode())


@pytest.mark.parametrize("requirement", sorted({*RUNS, *LANGUAGE_RUNS}, key=str), ids=lambda one: one.name)
def test_each_dependency_has_both_bounds(requirement: Requirement) -> None:
    locked = LOCKED[requirement.name]
    major, minor = locked.split(".")[:2]
    bounds = {one.operator: one.version for one in requirement.specifier}
    assert bounds == {">=": f"{major}.{minor}", "<": str(int(major) + 1)}


def test_the_constraints_name_every_package_that_pip_installs() -> None:
    made = subprocess.run(
        ["make", "--silent", "--no-print-directory", "constraints"],
        cwd=ROOT, env={name: value for name, value in os.environ.items() if name != "MAKEFLAGS"},
        check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    pinned = dict(line.split("==") for line in made.splitlines())
    assert pinned.items() >= LOCKED.items()
    waiting, found = [*RUNS], set[str]()
    while waiting:
        name = waiting.pop().name.lower()
        if name not in found:
            found.add(name)
            needed = map(Requirement, distribution(name).requires or ())
            waiting += [one for one in needed if one.marker is None or one.marker.evaluate({"extra": ""})]
    assert {re.sub(r"[-_.]+", "-", name) for name in found} <= pinned.keys()


def test_it_says_what_it_is(wheel: Path) -> None:
    says = metadata(wheel)
    assert (says["Name"], says["Version"]) == ("rosrv-appliance", __version__)
    assert (says["License-Expression"], says["Requires-Python"]) == ("Apache-2.0", ">=3.11")
    assert says.get_payload() == (ROOT / "README.md").read_text()
    assert {Requirement(one).name for one in says.get_all("Requires-Dist", [])} >= {run.name for run in RUNS}


def test_it_brings_what_is_not_code(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name.partition(".data/data/")[2] or name for name in archive.namelist()}
    tracked = subprocess.run(
        [
            "git", "-c", f"safe.directory={ROOT}", "ls-files", "examples", "monitors", "policies", "docs", "appliance",
            "roswire", "rosmop/*.py", ":!rosmop/tests",
        ],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    places = {"appliance": "", "roswire": "", "rosmop": "", "docs": "share/doc/rosrv/", "": "share/rosrv/"}
    expected = set()
    for path in tracked:
        top, _, rest = path.partition("/")
        place = places.get(top, places[""])
        expected.add(place + (rest if top == "docs" else path))
    assert expected - names == set()
    assert not [name for name in names if name.startswith("rosmop/tests")]


def test_it_contains_the_compiled_module(wheel: Path) -> None:
    named = rf"rosrv_appliance-{re.escape(__version__)}-cp311-abi3-manylinux_2_\d+_(x86_64|aarch64)\.whl"
    assert re.fullmatch(named, wheel.name)
    assert wheel in map(
        wheel.with_name, (f"{wheel.name.partition('-cp311')[0]}-{tag}.whl" for tag in sys_tags())
    )
    with zipfile.ZipFile(wheel) as archive:
        assert archive.read(str(IN_PLACE.relative_to(ROOT))) == IN_PLACE.read_bytes()
        facts = archive.read(f"{wheel.name.partition('-cp311')[0]}.dist-info/WHEEL").decode()
    assert "Root-Is-Purelib: false" in facts


def test_a_missing_compiler_differs_from_a_wrong_source(tmp_path: Path) -> None:
    source = tmp_path / "wrong.cpp"
    source.write_text("int main() { return ")
    build = ["/bin/bash", str(ROOT / "scripts/build-roscpp"), str(source), str(tmp_path / "made")]
    bare = subprocess.run(build, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False)
    assert (bare.returncode, "g++ and libroscpp-dev are needed" in bare.stderr) == (3, True)
