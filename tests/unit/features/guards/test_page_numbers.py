from pathlib import Path

import pytest

from appliance.features.guards.presets import PRESETS
from appliance.features.guards.robot_graph import VALUED
from rosmop.types.roles import types_of_roles

DOCS = Path(__file__).parents[4] / "docs"
DEFAULTS = [
    ("driving.md", "been silent for `silent` ({} s)", "deadman", "silent"),
    ("guards.md", "from the current rate: silent; check these defaults: resume={}", "deadman", "resume"),
    ("guards.md", "check these defaults: margin={}, …", "fence", "margin"),
    ("guards.md", "(default {} m/s and", "mode", "vMax"),
    ("guards.md", "m/s and {} rad/s)", "mode", "wMax"),
    ("reference/guards.md", "within `together` ({} s)", "estop", "together"),
    ("reference/guards.md", "the scanner sees all round (`sector={}`)", "separation", "sector"),
    ("reference/guards.md", "can be driven with `person={}`", "separation", "person"),
]
COUNTS = [
    ("guards.md", "six sensor types", 6, len(VALUED)),
    ("reference/guards.md", "has conditions for six types", 6, len(VALUED)),
    ("guards.md", "a topic of one of twelve types", 12, len(types_of_roles()["Private"])),
]


@pytest.mark.parametrize(("page", "words", "preset", "name"), DEFAULTS)
def test_a_default_on_a_page_is_the_presets(page: str, words: str, preset: str, name: str) -> None:
    [default] = [parameter.default for parameter in PRESETS[preset].parameters if parameter.name == name]
    assert words.format(default) in (DOCS / page).read_text().replace("\n", " ")


@pytest.mark.parametrize(("page", "words", "number", "counted"), COUNTS)
def test_a_number_of_types_on_a_page_is_counted(page: str, words: str, number: int, counted: int) -> None:
    assert words in (DOCS / page).read_text().replace("\n", " ")
    assert number == counted
