import ast
import re
from pathlib import Path

import pytest

from appliance.features.guards.evidence import EVIDENCE
from appliance.features.guards.presets import PRESETS
from lab.guards_evidence_page import page
from tests.support.rows import require_rows

ROOT = Path(__file__).parents[2]


@pytest.mark.complete
def test_every_preset_has_its_evidence() -> None:
    require_rows(PRESETS, EVIDENCE, "EVIDENCE of appliance/features/guards/evidence.py")
    for name, row in EVIDENCE.items():
        assert row.clauses and row.notices and row.fails and row.unit, name
        assert not row.silence or PRESETS[name].parameter(row.silence)
        for clause in row.clauses:
            assert clause.startswith("no standard: ") or re.match(
                r"(ISO|IEC)(/TS)? [\d-]+:20\d\d, (\d+(\.\d+)*|table \w\.\d|clause not known), ", clause
            ), clause


def test_every_test_on_the_page_exists() -> None:
    known = {
        node.name
        for folder in ("tests/unit", "tests/integration")
        for path in (ROOT / folder).rglob("test_*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
    named = {*re.findall(r"`(test_\w+)`", page())}
    assert named >= {one for row in EVIDENCE.values() for one in row.unit}
    assert named <= known, named - known
