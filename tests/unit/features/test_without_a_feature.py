"""Without any one of the features, all other code works."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from appliance.features.table import NAMES
from tests.unit.features.test_boundaries import OF_MANY, features_in_tests

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(1200)]
ROOT = Path(__file__).parents[3]
_TESTED = ("configuration", "supervisor", "control", "channel", "test_imports.py", "test_source_rules.py")
_EVERYTHING = """
import importlib, pkgutil, appliance
for module in pkgutil.walk_packages(appliance.__path__, "appliance."):
    importlib.import_module(module.name)
"""


def without(name: str, copy: Path) -> None:
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    of_many = [file for file in OF_MANY if name in features_in_tests()[file]]
    for file in filter(None, files.decode().split("\0")):
        if f"/features/{name}/" not in file and file not in of_many and (ROOT / file).is_file():
            (copy / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / file, copy / file)
    for built in (ROOT / "appliance").rglob("*.so"):
        shutil.copy2(built, copy / built.relative_to(ROOT))
    for table in (copy / "appliance/features/table.py", copy / "appliance/features/views.py"):
        text = table.read_text(encoding="utf-8")
        text = re.sub(rf"from appliance\.features\.{name}\..*\n", "", text)
        text = re.sub(rf"\b{name.upper()}_VIEW\b(, |,)?", "", text)
        table.write_text(re.sub(rf'    "{name}",\n', "", text), encoding="utf-8")
    contracts = copy / "pyproject.toml"  # no import of the feature is left to ignore
    text = re.sub("unmatched_ignore_imports_alerting = .*\n", "", contracts.read_text(encoding="utf-8"))
    silent = 'unmatched_ignore_imports_alerting = "none"\nignore_imports = ['
    contracts.write_text(text.replace("ignore_imports = [", silent), encoding="utf-8")


@pytest.mark.parametrize("name", sorted(NAMES))
def test_the_rest_works_without_a_feature(name: str, tmp_path: Path) -> None:
    without(name, tmp_path)
    bin_folder = Path(sys.executable).parent
    tests = [f"tests/unit/{one}" for one in _TESTED]
    for command in (
        [sys.executable, "-c", _EVERYTHING],
        [str(bin_folder / "lint-imports"), "--no-cache"],
        [sys.executable, "-m", "pytest", "--collect-only", "-q", "tests/unit"],
        [sys.executable, "-m", "pytest", "-q", "-m", "not nightly and not real", *tests],
    ):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command}: {done.stdout[-3000:]}{done.stderr[-2000:]}"
