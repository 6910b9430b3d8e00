"""Faults that are planted in the texts of presets are found without a solver."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

from rosmop.tests.prove.preset_faults import difference, faults

ROOT = Path(__file__).parents[3]
GUARDS = ROOT / "monitors" / "guards"
ASSURANCE = ROOT / "docs" / "dev" / "assurance.md"

STOPS = "the safe message is for another topic: every module leaves this path to Python"
MORE = "the module leaves more messages to Python, which does what the text says"
SURVIVORS: Mapping[str, Mapping[str, str]] = MappingProxyType({
    "fence": {
        "if (!isfinite(x) »|| !isfinite(y) || !isfinite(atX) || !isfinite(atY)) { return false; }":
            "equivalent: with one part that is not finite the speed is not finite, which is tested below",
        "if (!isfinite(speed) »|| speed == 0) { return false; }":
            "equivalent for all values that `margin` and `ahead` may have: the speed is 0 only if both parts are, and a"
            " position that far away is outside",
        "turned = norm »> 0.01 ? yaw(q) : NAN;":
            "not found: they differ only if four squares add up to exactly 0.01",
        "lastX = »0;": STOPS,
        "lastY = »0;": STOPS,
        "»lastX = 0;": STOPS,
        "»lastY = 0;": STOPS,
    },
    "sensor": {
        "if (isfinite(v)) { finite++; } else { v = isnan(v) ? 1000.5 : v »> 0 ? 2000.5 : 3000.5; }":
            "equivalent: here the number is infinite",
        "if (isfinite(v)) { finite++; } else { v = isnan(v) ? 1000.5 : v > »0 ? 2000.5 : 3000.5; }":
            "equivalent: here the number is infinite",
    },
    "separation": {
        "bool backward(double x, double y, double z) { return sector <= 1.6 && x »<= 0 && y == 0 && z == 0; }":
            "equivalent: a velocity of zeros is below every limit",
        "if (speed »> fastest(0) && !backward(lastX, lastY, lastZ)) {": MORE,
        "if (speed > fastest(0) »&& !backward(lastX, lastY, lastZ)) {": MORE,
        "if (speed > fastest(»0) && !backward(lastX, lastY, lastZ)) {": MORE,
        "lastX = »0; lastY = 0; lastZ = 0;": STOPS,
        "lastX = 0; lastY = »0; lastZ = 0;": STOPS,
        "lastX = 0; lastY = 0; lastZ = »0;": STOPS,
        "»lastX = 0; lastY = 0; lastZ = 0;": STOPS,
        "lastX = 0; »lastY = 0; lastZ = 0;": STOPS,
        "lastX = 0; lastY = 0; »lastZ = 0;": STOPS,
    },
    "speed": {},
})  # fmt: skip
"""Faults that no run shows, with the reason."""

PLANTED = {"fence": 93, "sensor": 49, "separation": 79, "speed": 47}


@pytest.mark.nightly
@pytest.mark.timeout(1200)  # beside other work, the longest takes more than the usual five minutes
@pytest.mark.parametrize("name", SURVIVORS)
def test_every_fault_in_a_preset_is_shown_by_a_run(name: str) -> None:
    """Except the listed ones, each of which no run shows."""
    text = (GUARDS / f"{name}.rv").read_text()
    planted = [*faults(text)]
    assert len(planted) == PLANTED[name]
    assert difference(text, text) is None
    survived = Counter(line for line, faulty in planted if difference(text, faulty) is None)
    assert survived == Counter([*SURVIVORS[name]])


@pytest.mark.parametrize("name", SURVIVORS)
def test_the_page_has_the_figures(name: str) -> None:
    kinds = [reason.partition(":")[0].partition(" for")[0] for reason in SURVIVORS[name].values()]
    equivalent, missing = kinds.count("equivalent"), kinds.count("not found")
    left, refuted = len(kinds) - equivalent - missing, PLANTED[name] - len(kinds)
    row = f"| `{name}` | {PLANTED[name]} | {refuted} | {equivalent} | {left} | {missing} |"
    assert row in ASSURANCE.read_text().splitlines()
