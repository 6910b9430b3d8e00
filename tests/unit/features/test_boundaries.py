"""Neither the core nor its tests know a feature."""

import inspect
import re
import typing
from functools import cache
from pathlib import Path

import pytest

from appliance.control.core import ControlPart, Core
from appliance.features.feature import Feature
from appliance.features.table import FOLDERS as TABLE
from appliance.features.table import member

ROOT = Path(__file__).parents[3]
FOLDERS = sorted(path.parent.name for path in (ROOT / "appliance/features").glob("*/feature.py"))
_FEATURE = re.compile(r"\bappliance\.features\.(\w+)")
_OURS = re.compile(
    r"^(?:from|import) ((?:benchmarks|distribution|lab|tests)\b[\w.]*)(?: import ([\w, ]+))?", re.MULTILINE
)
UNIT = ROOT / "tests/unit"
WORLD = ROOT / "tests/world"  # simulates the whole product, also as one of two appliances


def test_each_folder_is_a_row() -> None:
    assert sorted(TABLE) == FOLDERS


OF_MANY = {
    "tests/integration/test_denials.py": "denials count wherever a feature shows them",
    "tests/integration/test_losses.py": "calls that wait for an approval end with a loss, like all else",
    "tests/integration/test_own_log.py": "each process gets a log that cannot be written",
    "tests/unit/cli/test_watching.py": "each verb that watches gets the same rejections",
    "tests/unit/control/test_motion_stop.py": "each right that a restart ends is stopped by the same work",
    "tests/unit/master/endpoints/test_silence.py": "each right that a silence ends gets the same reports",
    "tests/unit/texts/test_hostile_texts.py": "each entrance and output gets the same texts",
}


@cache
def _named(file: Path) -> tuple[set[str], list[Path]]:
    """Return the features that a file names, and the files outside of the products that it imports."""
    text = file.read_text(encoding="utf-8")
    imports = ((ROOT / module.replace(".", "/"), names.split(", ")) for module, names in _OURS.findall(text))
    files = [(module / name).with_suffix(".py") for module, names in imports for name in ("", *names)]
    return set(_FEATURE.findall(text)), [one for one in files if one.is_file() and WORLD not in one.parents]


@cache
def features_in_tests() -> dict[str, set[str]]:
    """Return the features that each file of tests names, outside of the world; a unit test also through its imports."""
    found = {}
    for path in (ROOT / "tests").rglob("*.py"):
        if WORLD not in path.parents:
            files = [path]
            for file in files if UNIT in path.parents else ():
                files.extend(set(_named(file)[1]).difference(files))
            found[str(path.relative_to(ROOT))] = {name for file in files for name in _named(file)[0]}
    return found


@pytest.mark.parametrize("name", FOLDERS)
def test_no_other_test_imports_a_feature(name: str) -> None:
    knowing = [
        file
        for file, features in features_in_tests().items()
        if name in features and file not in OF_MANY and not re.search(rf"(features|system)/{name}/", file)
    ]
    assert not knowing, f"only tests in a folder features/{name} may import {name}: move them from {knowing}"


_MEMBERS = {
    "control_part": "begin",
    "gate": "GATE",
    "machine_side": "machine",
    "pairing": "pairing_in",
    "replay_input": "recorded_messages",
    "requests": "REQUESTS",
    "routes": "routes",
    "state_files": "STATE_FILES",
}


@pytest.mark.parametrize("name", FOLDERS)
def test_the_files_of_a_feature_define_what_the_core_looks_for(name: str) -> None:
    files = {path.stem for path in (ROOT / "appliance/features" / name).glob("*.py")} & _MEMBERS.keys()
    assert [file for file in files if member(name, file, _MEMBERS[file]) is None] == []
    if "control_part" in files:
        begin = member(name, "control_part", "begin")
        assert inspect.iscoroutinefunction(begin)
        assert typing.get_type_hints(begin) == {"core": Core, "return": ControlPart}
    assert isinstance(TABLE[name], Feature) or files <= {"routes"}, "a tool has verbs and routes only"
