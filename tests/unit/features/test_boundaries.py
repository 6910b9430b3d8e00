"""Neither the core nor its tests know a feature."""

import re
from pathlib import Path

import pytest

from appliance.features.table import TOOLS

ROOT = Path(__file__).parents[3]
FOLDERS = sorted(path.parent.name for path in (ROOT / "appliance/features").glob("*/feature.py"))
WORLD = ROOT / "tests/world"  # simulates the whole product, also as one of two appliances


def test_each_folder_is_a_row() -> None:
    assert sorted(tool.name for tool in TOOLS) == FOLDERS


@pytest.mark.parametrize("name", FOLDERS)
def test_no_other_test_imports_a_feature(name: str) -> None:
    imported = re.compile(rf"\bappliance\.features\.{name}\b")
    knowing = [
        str(path.relative_to(ROOT))
        for path in (ROOT / "tests").rglob("*.py")
        if not re.search(rf"(features|system)/{name}/", str(path))
        and WORLD not in path.parents
        and imported.search(path.read_text(encoding="utf-8"))
    ]
    assert knowing == []
