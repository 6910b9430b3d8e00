import re
from itertools import product
from pathlib import Path

import pytest

from appliance.channel.rest_bodies import NOTE_LENGTH
from appliance.features.guards.guard_order import PRECEDENCES
from appliance.features.guards.presets import (
    FOLDER,
    PRESETS,
    Guard,
    GuardError,
    Head,
    Preset,
    below_the_standard,
    description_of,
    head_of,
    keeps_state,
    preset_of,
    text_of,
    topics_in,
    values_in,
    with_values,
)
from appliance.features.guards.show_verb import remarks
from appliance.supervisor.sandbox.private_view import program_folders
from rosmop.check.sources import compiled_from
from rosmop.fast.build import fast_path_of
from rosmop.form.compiled import Compiled
from rosmop.run.engine import MonitorSet
from rosmop.text.parser import parse
from rosmop.text.tree import GivenValue
from rosmop.types.given_lists import EXAMPLES
from rosmop.types.roles import ANY_TYPE
from tests.support.examples import covering
from tests.support.features.guards.guarded_robot import rows
from tests.support.features.guards.running_guard import DEFINITIONS
from tests.support.rows import require_rows

ROOT = Path(__file__).parents[4]
INTERPRETED = {"answer"}
"""Presets with slices, which the compiled module leaves to the engine."""


def compiled(text: str) -> Compiled:
    found = compiled_from({"guard.rv": text}, DEFINITIONS)
    assert not found.warnings
    return found


def _fits(kinds: tuple[str, ...]) -> bool:
    """Whether the types are of one action: results of goals of another type answer nothing."""
    goal, result = kinds[0], kinds[-1]
    return not result.endswith("Result") or result == goal.replace("Goal", "Result")


@pytest.mark.parametrize(
    ("preset", "name"),
    [(preset, one.name) for preset in PRESETS.values() for one in preset.parameters if one.loads],
)
def test_a_dry_run_says_whether_a_guard_keeps_its_state(preset: Preset, name: str) -> None:
    text = text_of(Guard("guard", preset))
    example = {**EXAMPLES, "time": "7s"}[preset.parameter(name).kind]
    before = MonitorSet.of(compiled(text))
    before.start(0)
    after = MonitorSet.of(compiled(with_values(text, {name: example})))
    after.succeed(before, 1)
    assert keeps_state(text, {name}) is ("guard" not in after.began)


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_preset_is_valid_as_it_is_and_for_each_of_its_types(preset: Preset) -> None:
    [code] = compiled(preset.text).specifications
    given = {one.name: (one.default, one.unit) for one in code.givens}
    read = {one.name: (one.default, one.unit) for one in preset.parameters if not one.loads}
    assert {
        name: (str(default).lower().removesuffix(".0"), unit) for name, (default, unit) in given.items()
    } == read
    for kinds in covering(filter(_fits, product(*preset.topics.values()))):
        types = {
            topic: kind.replace(ANY_TYPE, "std_msgs/Header")
            for topic, kind in zip(preset.topics, kinds, strict=True)
        }
        made = compiled(text_of(Guard("mine", preset, {"command": "/base/goal"}, types)))
        assert made.specifications[0].name == "mine"
        running = MonitorSet.of(made, fast=fast_path_of(made))
        assert (running.lane("/base/goal") is None) == (preset.name in INTERPRETED)
        assert (
            types.get("by") != "sensor_msgs/LaserScan" or running.lane(preset.given_topics["by"]) is not None
        )


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_load_with_other_topics_makes_the_guard_that_a_text_with_them_makes(preset: Preset) -> None:
    """So it cancels the goals of the base that it observes now, and of no other."""
    others = {name: f"/other/{name}/goal" for name in preset.given_topics}
    rows_of_types = covering(filter(_fits, product(*preset.topics.values())))
    default = tuple(types[0] for types in preset.topics.values())
    for kinds in (default, *(each for each in rows_of_types if each[0].endswith("ActionGoal"))):
        types = {
            topic: kind.replace(ANY_TYPE, "std_msgs/Header")
            for topic, kind in zip(preset.topics, kinds, strict=True)
        }
        text = text_of(Guard("mine", preset, {"command": "/base/goal"}, types))
        loaded, made = (
            compiled_from({"guard.rv": one}, DEFINITIONS, lints=False, topics={"mine": topics})
            for one, topics in (
                (text, {"cancel": "/mine", **others}), (text_of(Guard("mine", preset, others, types)), {}),
            )
        )  # fmt: skip
        [code], [wanted] = loaded.specifications, made.specifications
        assert {topic.name for topic in code.given_topics} == others.keys()
        assert [event.topic for event in code.events] == [event.topic for event in wanted.events]
        assert (code.acts_on, [safe.topic for safe in code.safes]) == (
            wanted.acts_on, [safe.topic for safe in wanted.safes],
        )  # fmt: skip
        assert {one.topic for one in loaded.publications} == {one.topic for one in made.publications}


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_declaration_has_the_remark_of_its_line_or_no_meaning(preset: Preset) -> None:
    text = text_of(Guard("mine", preset))
    lines, found = text.splitlines(), remarks(text)
    [made] = parse(text, "mine.rv").specifications
    for declaration in made.declarations:
        line = lines[declaration.position.line - 1]
        own = [one.name for one in declaration.declarators if re.search(rf"\b{one.name}\b", line)]
        assert {name: found.get(name, "") for name in own} == dict.fromkeys(own, line.partition(" // ")[2])
    for given in (one for one in made.givens if isinstance(one, GivenValue)):
        assert found.get(given.name, "") == lines[given.position.line - 1].partition(" // ")[2]


OF_THE_SITE = {("separation", "margin"), *((name, "publishers") for name in ("estop", "hold_to_run", "mode"))}
"""Values of which only the site has the safe one; `guard list` names the default."""


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_default_is_safe_by_the_standard_and_a_value_below_it_is_named(preset: Preset) -> None:
    for parameter in preset.parameters:
        unsafe = (preset.name, parameter.name) in OF_THE_SITE
        assert parameter.falls_below(parameter.default) == unsafe, parameter.name
        values = {"true", "false"} if parameter.kind == "bool" else {parameter.least, parameter.most}
        assert not parameter.safe or any(map(parameter.falls_below, values)), (
            f"{parameter.name} is always safe"
        )
    assert below_the_standard(PRESETS["estop"], {"silent": "0", "zeroFirst": "true"}) == [
        "silent=0 is below the standard: > 0"
    ]


def test_a_guard_is_its_preset_with_topics_types_and_values() -> None:
    types = {"command": "geometry_msgs/TwistStamped", "by": "geometry_msgs/PoseStamped"}
    text = text_of(
        Guard("yard", PRESETS["fence"], {"command": "/base/cmd", "by": "/pose"}, types,
              {"margin": "0.5", "polygon": "0,0 4,0  0,3.5", "worldFrame": "true"})
    )  # fmt: skip
    assert (
        text
        == f"""preset fence {PRESETS["fence"].version} as yard {{
    command = /base/cmd geometry_msgs/TwistStamped;
    by = /pose geometry_msgs/PoseStamped;
    margin = 0.5;
    polygon = 0,0 4,0 0,3.5;
    worldFrame = true;
}}
{PRESETS["fence"].body}"""
    )
    assert description_of(text) == (
        f"preset fence {PRESETS['fence'].version}: command=/base/cmd geometry_msgs/TwistStamped,"
        " by=/pose geometry_msgs/PoseStamped"
    )
    assert len(description_of(text.replace("/base/cmd", "/arm_controller" * 20))) == NOTE_LENGTH
    made = preset_of(text)
    assert made is not None
    assert (made.name, made.text, made.version) == ("fence", text, PRESETS["fence"].version)
    assert text.replace("0,0 4,0 0,3.5", "1,1 2,1 2,2") == with_values(text, {"polygon": "1,1 2,1 2,2"})
    [code] = compiled(text).specifications
    assert {event.topic for event in code.events if event.topic} == {"/base/cmd", "/pose"}


def test_a_name_of_an_entry_is_not_a_topic() -> None:
    text = text_of(Guard("guard", PRESETS["diagnostics"], values={"named": " /Robot/*,Battery: (A) "}))
    assert topics_in(text) == {"command": "/cmd_vel", "by": "/diagnostics"}
    assert values_in(text)["named"] == "/Robot/*,Battery: (A)"


def test_a_preset_statement_is_read_however_it_is_written() -> None:
    guard = Guard("yard", PRESETS["fence"], {"command": "/base/cmd"}, values={"margin": "0.5"})
    text = text_of(guard)
    statement = text.removesuffix(guard.preset.body)
    with_remarks = statement.replace("{", "{   // our } yard; margin = 9").replace(
        "0.5;", "0.5;  // metres = 1;"
    )
    for written in (statement, with_remarks, " ".join(statement.split()) + "\n"):
        other = written + guard.preset.body
        assert head_of(other) == head_of(text) and with_values(other, {}) == text
        [here], [there] = (compiled(one).specifications for one in (other, text))
        assert here.identity == there.identity
    assert head_of("preset fence 3;  // ours\n") == Head("fence", 3, "fence", {})


WRONG = [
    ("speed", "base", {}, {}, {"vMax": "51"}, "outside of 0..50 m/s"),
    ("speed", "base", {}, {}, {"vMax": "nan"}, "give a number, in m/s"),
    ("speed", "base", {}, {}, {"vMax": "1;}"}, "give a number"),
    ("speed", "base", {}, {}, {"vmax": "1"}, "use one of: vMax"),
    ("estop", "base", {}, {}, {"twoHands": "1"}, "twoHands=true or twoHands=false"),
    ("sensor", "base", {}, {}, {"frozen": "1.5"}, "give a whole number"),
    ("fence", "base", {}, {}, {"polygon": "0,0 1,1"}, "write it like polygon="),
    ("fence", "base", {}, {}, {"polygon": "0,0 1,1 nan,2"}, "write it like polygon="),
    ("fence", "base", {}, {}, {"polygon": "10,10 " * 60 + "x"}, "write it like polygon="),
    ("fence", "base", {}, {}, {"polygon": "0,0 1,1 1,\N{ARABIC-INDIC DIGIT ONE}"}, "write it like polygon="),
    ("fence", "base", {}, {}, {"polygon": "-2,-2 2,2 2,-2 -2,2"}, "edges cross"),
    ("fence", "base", {}, {}, {"polygon": "0,0 1,1 2,2 1,1"}, "the corners are on one line"),
    ("fence", "base", {}, {}, {"polygon": "1,1 1,1 1,1"}, "the corners are on one line"),
    ("joints", "base", {}, {}, {"limits": 'a":1..2'}, "write it like limits="),
    ("joints", "base", {}, {}, {"limits": "a:10..20 " * 60 + "x"}, "write it like limits="),
    ("answer", "base", {}, {}, {"limit": "5"}, "write it like limit="),
    *(
        ("diagnostics", "base", {}, {}, {"named": named}, "write it like named=")
        for named in ("", "a,,b", "a*b", "a;b", "a}", "a//b", "a/*b", "hardware_id:")
    ),
    ("diagnostics", "base", {}, {}, {"named": ", ".join("a" * 17)}, "at most 16 entries can be named"),
    ("withhold", "base", {}, {}, {"hosts": "tablet"}, "write it like hosts="),
    ("speed", "a b", {}, {}, {}, "not a name of a monitor"),
    ("speed", "base", {"command": "cmd"}, {}, {}, "not the name of a topic"),
    ("speed", "base", {"by": "/odom"}, {}, {}, "no topic 'by' is given to speed"),
    ("speed", "base", {"command": "/c"}, {"command": "std_msgs/Bool"}, {},
     "/c has the type std_msgs/Bool; speed works"),
]  # fmt: skip


@pytest.mark.parametrize(("preset", "name", "topics", "types", "values", "why"), WRONG)
def test_a_guard_that_cannot_be_made_is_refused(  # noqa: PLR0917  a row
    preset: str, name: str, topics: dict[str, str], types: dict[str, str], values: dict[str, str], why: str
) -> None:
    with pytest.raises(GuardError) as error:
        text_of(Guard(name, PRESETS[preset], topics, types, values))
    assert why in str(error.value)


NO_TEST = "**the appliance's machine**"
"""No part of the appliance acts then."""


def test_the_page_names_an_existing_test_for_each_row() -> None:
    """Also the case in brackets exists. Only the row of `NO_TEST` has none."""
    page = (ROOT / "docs" / "reference" / "guards.md").read_text(encoding="utf-8")
    section = page.partition("## When the base is stopped")[2].partition("### Records of a stop")[0]
    rows = [row for row in section.splitlines() if row.startswith("| ") and not row.endswith(" test |")]
    cells = [row.split("|")[-2].strip().strip("`") for row in rows]
    tests = [one for cell in cells if cell for one in cell.split("`, `")]
    named = [re.fullmatch(r"(test_\w+)(?:\[(.*)\])?", test) for test in tests]
    untested = [row.split("|")[1].strip() for row in rows if row.endswith("| |")]
    assert len(rows) == 24 and untested == [NO_TEST]
    files = [file for folder in ("tests", "rosmop/tests") for file in (ROOT / folder).rglob("test_*.py")]
    texts = [file.read_text(encoding="utf-8") for file in files]
    for found in named:
        assert found is not None
        there = [text for text in texts if re.search(rf"^(?:async )?def {found[1]}\(", text, re.MULTILINE)]
        assert there, found[0]
        assert found[2] is None or any(f'"{found[2]}"' in text for text in there), found[0]


def test_processes_see_the_presets_of_a_checkout_in_a_closed_home() -> None:
    assert any(FOLDER.is_relative_to(part) for part in program_folders())


NOT_ORDERED = {"withhold": "it changes and drops no message"}


@pytest.mark.complete
def test_a_preset_has_its_place_in_the_order_and_on_the_page() -> None:
    ordered = {name for row in PRECEDENCES for name in (*row.first, *row.then)}
    where = "PRECEDENCES of guard_order.py, or to NOT_ORDERED here with the reason"
    require_rows(PRESETS, ordered | NOT_ORDERED.keys(), where)
    assert not ordered & NOT_ORDERED.keys()
    page = (ROOT / "docs" / "guards.md").read_text(encoding="utf-8")
    section = page.partition("## Presets")[2].partition("\n## ")[0]
    for name in PRESETS:
        assert section.count(f"\n| `{name}` |") == 2, f"{name}: add a row to both tables of docs/guards.md"


@pytest.mark.parametrize("topic", ["/1/cmd_vel", "/robots/1/cmd_vel", "/robot/_x"])
def test_a_guard_of_a_robot_with_a_number_is_made(topic: str) -> None:
    text = text_of(Guard("fast", PRESETS["speed"], {"command": topic}))
    assert (topics_in(text)["command"], *compiled(text).specifications[0].acts_on) == (topic, topic)
    with pytest.raises(GuardError, match="not the name of a topic"):
        text_of(Guard("fast", PRESETS["speed"], {"command": f"{topic}/"}))


def test_a_mistyped_type_is_answered_with_the_nearest() -> None:
    guard = Guard(
        "speed", PRESETS["speed"], {"command": "/cmd_vel"}, types={"command": "geometry_msgs/Twits"}
    )
    with pytest.raises(GuardError, match=r"did you mean geometry_msgs/Twist\?"):
        text_of(guard)


@pytest.mark.complete
def test_each_preset_is_tried_in_an_appliance() -> None:
    """Each of its topics has the messages of a robot."""
    topics = {
        f"{path.stem} {name}" for path in FOLDER.glob("*.rv") for name in Preset(path.stem).given_topics
    }
    streams = {f"{row.preset} {name}" for row in rows() for name in row.streams}
    require_rows(
        topics - {"answer cancel"}, streams, "rows in tests/support/features/guards/guarded_robot.py"
    )
