"""Faults that are planted in the texts of presets are found without a solver."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

from rosmop.tests.prove.preset_faults import difference, faults

ROOT = Path(__file__).parents[3]
GUARDS = ROOT / "monitors" / "guards"
ASSURANCE = ROOT / "docs" / "dev" / "assurance.md"

PLANTED: Mapping[str, tuple[int, int]] = MappingProxyType({"sensor": (88, 15), "speed": (140, 30)})
"""By preset, the number of faults, and of those that no run shows."""


@pytest.mark.nightly
@pytest.mark.timeout(1200)  # beside other work, the longest takes more than the usual five minutes
@pytest.mark.parametrize("name", PLANTED)
def test_faults_in_a_preset_are_shown_by_runs(name: str) -> None:
    text = (GUARDS / f"{name}.rv").read_text()
    planted = [*faults(text)]
    assert difference(text, text) is None
    hidden = [line for line, faulty in planted if difference(text, faulty) is None]
    assert (len(planted), len(hidden)) == PLANTED[name], "\n".join(hidden)


@pytest.mark.parametrize("name", PLANTED)
def test_the_page_has_the_figures(name: str) -> None:
    planted, hidden = PLANTED[name]
    assert len([*faults((GUARDS / f"{name}.rv").read_text())]) == planted
    row = f"| `{name}` | {planted} | {planted - hidden} | {hidden} |"
    assert row in ASSURANCE.read_text().splitlines()
