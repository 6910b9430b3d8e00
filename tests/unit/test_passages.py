import re
from functools import cache

import pytest

from tests.support.sources import ROOT

PAGE = (ROOT / "docs/dev/passages.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.+)\n((?:(?!## ).*\n)*)", PAGE, re.MULTILINE))
THINGS = (
    "Firewall rules", "Translations of `isolation: netns`", "Open connections", "Lists of publishers at nodes",
    "Registrations at RVMaster", "Registrations at the robot's own master", "Types at doors", "Grants in relays",
    "Sources awaited by monitors", "Leases of groups", "The lease of a pair", "Approvals", "Counters", "Timers",
    "Threads", "Sockets", "Certificates", "The program's own log",
)  # fmt: skip
MOMENTS = (
    "first use", "a second one", "late", "lost and back", "replaced", "twice at once", "too slow", "hostile first",
    "restarted", "taken over", "full and free",
)  # fmt: skip


@cache
def names_in(file: str) -> frozenset[str]:
    return frozenset(re.findall(r"def (test_\w+)\(", (ROOT / "tests" / file).read_text(encoding="utf-8")))


def test_the_page_has_each_thing_that_the_appliance_keeps_for_others() -> None:
    assert tuple(SECTIONS) == THINGS


@pytest.mark.parametrize("thing", SECTIONS)
def test_each_moment_of_a_thing_has_tests_that_are_marked_right(thing: str) -> None:
    rows = re.findall(r"^\| (.+) \| (.+) \| (.+) \|$", SECTIONS[thing], re.MULTILINE)[1:]
    assert tuple(moment for moment, *_ in rows) == MOMENTS
    for moment, _happens, cell in rows:
        named = re.findall(r"`([^`]+)::([^`]+)`", cell)
        assert [name for file, name in named if name not in names_in(file)] == [], moment
        double = all(file.startswith("unit/") for file, _name in named)
        mark = ("*double*" if double else "") if named else ("*open*" if "*open*" in cell else "-")
        assert cell == " ".join(filter(None, (mark, *(f"`{file}::{name}`" for file, name in named)))), moment
