import re
from pathlib import Path

import pytest

from rosmop.check.function_library import FREE, TEXT, functions
from rosmop.check.loops import MAX_NESTED
from rosmop.check.members import TEXT_METHODS, TIME_METHODS
from rosmop.check.sources import compiled_from
from rosmop.check.standard_functions import LIBRARY
from rosmop.check.vector_members import VECTOR_METHODS
from rosmop.fast.build import certify, require_loadable
from rosmop.runtime.action_context import BUDGET, MAX_BYTES, MAX_CALLS
from rosmop.runtime.numbers import MATH
from rosmop.tests.acting import definitions, load
from rosmop.text.parser import MAX_CHARACTERS, MAX_DEPTH

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "rv-language.md").read_text()
EXAMPLE, GIVEN, PRESET, ROLE, ORDER, SAFE, WITHHELD, CALLS, VARIABLES, FUNCTIONS, PROPERTY, SLICED = (
    re.findall(r"```cpp\n(.*?)```", PAGE, re.DOTALL)
)


def test_the_example_loads() -> None:
    assert [monitor.name for monitor in load(EXAMPLE).monitors] == ["safeTrigger"]


def test_the_example_of_a_property_loads() -> None:
    events = "event go() /t std_msgs/Empty '{}' { } event stop() /u std_msgs/Empty '{}' { }"
    assert load(f"s() {{ {events} {PROPERTY} }}").monitors[0].properties


def test_each_function_in_rv_is_on_the_page_with_its_parameters() -> None:
    heads = {found[2]: found[1] for found in re.finditer(r"^([\w:]+ (\w+)\([^)]*\)) \{", TEXT, re.MULTILINE)}
    assert set(heads) == set(functions())
    shown = re.sub(r"; *(//.*)?$", "", FUNCTIONS, flags=re.MULTILINE).strip().split("\n")
    assert set(shown) == {head for name, head in heads.items() if name not in FREE | {"isfinite_all"}}


def in_specification(members: str, action: str = "") -> str:
    events = "event go() /t std_msgs/Empty '{}' { } event stop() /u std_msgs/Empty '{}' { }"
    drive = f"event drive(double v) /cmd_vel geometry_msgs/Twist '{{linear.x:v}}' {{ {action} }}"
    return f"s() {{ {members} {events} {drive} }}"


HELPER = next(re.finditer(r"`(double half.*?})`", PAGE))[1]


@pytest.mark.parametrize(
    "text",
    [
        EXAMPLE,
        f"s() {{ {VARIABLES} }}",
        f"s() {{ {CALLS} }}",
        in_specification(PROPERTY),
        SLICED,
        SAFE + ORDER,
        GIVEN,
        PRESET,
        ROLE,
        in_specification(HELPER, "v = half(v);"),
    ],
)
def test_every_sample_is_loaded_as_a_relay_loads_it(text: str) -> None:
    require_loadable(certify(compiled_from({"sample.rv": text}, definitions())).data)


@pytest.mark.parametrize(
    "kind",
    ["bool", "char", "short", "int", "long", "unsigned long", "float", "double", "std::string", "ros::Time"],
)
def test_helpers_that_return_any_type_are_loaded(kind: str) -> None:
    helper = f"{kind} of({kind} x) {{ return x; }} {kind} kept;"
    text = in_specification(helper, "kept = of(kept); if (v > 1) { return; }")
    require_loadable(certify(compiled_from({"sample.rv": text}, definitions())).data)


def row(head: str) -> str:
    return next(line for line in PAGE.splitlines() if line.startswith(f"| {head} "))


@pytest.mark.parametrize(
    ("head", "names"),
    [
        ("`<math.h>`", MATH),
        ("strings", TEXT_METHODS),
        ("vectors", VECTOR_METHODS),
        ("`ros::Time`, `ros::Duration`", TIME_METHODS),
    ],
)
def test_every_function_is_on_the_page(head: str, names: dict[str, object]) -> None:
    words = set(re.findall(r"\w+", row(head)))
    assert set(names) - words - {"data", "nearbyint", "fromNSec"} == set()


def test_every_function_of_the_library_is_on_the_page() -> None:
    words = set(re.findall(r"\w+", PAGE))
    words |= {f"{name}f" for name in MATH} if "(also as `sqrtf`, …)" in PAGE else set()
    assert (
        set(LIBRARY) - words - {"labs", "llabs", "stoll", "stoull", "atol", "strcmp", "strlen", "nearbyint"}
        == set()
    )


def test_the_limits_are_those_of_the_code() -> None:
    assert f"{BUDGET:,};" in row("instructions for one message and specification")
    assert f"| {MAX_BYTES >> 20} MiB |" in PAGE
    assert f"| {MAX_CALLS} deep |" in PAGE
    assert f"{MAX_CHARACTERS // 1024} Ki characters; {MAX_DEPTH}; {MAX_NESTED} |" in PAGE
