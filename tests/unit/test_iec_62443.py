import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "threat-model.md"
# A network device at SL 2. CR 2.3, 5.4 and 7.5 require nothing of a component; CR 2.7 begins at SL 3.
REQUIRED = """
CR 1.1, CR 1.1 RE 1, CR 1.2, CR 1.3, CR 1.4, CR 1.5, NDR 1.6, NDR 1.6 RE 1, CR 1.7, CR 1.8, CR 1.9, CR 1.10, CR 1.11,
CR 1.12, NDR 1.13, CR 1.14,
CR 2.1, CR 2.1 RE 1, CR 2.1 RE 2, CR 2.2, NDR 2.4, NDR 2.4 RE 1, CR 2.5, CR 2.6, CR 2.8, CR 2.9, CR 2.10, CR 2.11,
CR 2.11 RE 1, CR 2.12, NDR 2.13,
CR 3.1, CR 3.1 RE 1, NDR 3.2, CR 3.3, CR 3.4, CR 3.4 RE 1, CR 3.5, CR 3.6, CR 3.7, CR 3.8, CR 3.9, NDR 3.10,
NDR 3.10 RE 1, NDR 3.11, NDR 3.12, NDR 3.13, NDR 3.14, NDR 3.14 RE 1,
CR 4.1, CR 4.2, CR 4.3,
CR 5.1, NDR 5.2, NDR 5.2 RE 1, NDR 5.3,
CR 6.1, CR 6.2,
CR 7.1, CR 7.1 RE 1, CR 7.2, CR 7.3, CR 7.3 RE 1, CR 7.4, CR 7.6, CR 7.7, CR 7.8
"""
ROWS = re.findall(
    r"^\| ((?:CR|NDR) [^|]+?) \| (\w+) \| ([^|]+?) \| ([^|]*?) ?\|$", PAGE.read_text(), re.MULTILINE
)


def test_every_requirement_has_one_row() -> None:
    assert [row[0] for row in ROWS] == [name.strip() for name in REQUIRED.strip().split(",")]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: str(row[0]))
def test_every_claim_names_a_test(row: tuple[str, str, str, str]) -> None:
    requirement, state, how, shown = row
    assert state in ("met", "site", "partly", "no", "none"), requirement
    assert len(how) > 10, requirement
    if state in ("met", "partly"):
        assert "::test_" in shown or re.search(r"`\w+/[\w/]+\.py`", shown), requirement
    if state in ("no", "none"):
        assert shown == "", requirement
