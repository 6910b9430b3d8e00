"""Guards of released versions are recognised by their texts, and upgraded with their values."""

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

from appliance.features.guards import released, upgrades
from appliance.features.guards.presets import (
    PRESETS,
    Guard,
    GuardError,
    Parameter,
    Preset,
    preset_named,
    preset_of,
    text_of,
    topics_in,
    types_in,
    values_in,
    with_values,
)
from appliance.features.guards.released import FOLDER, origin_of
from appliance.features.guards.robot_graph import TopicFacts
from appliance.features.guards.upgrades import upgrade_of
from distribution import released_presets
from rosmop.types.roles import ANY_TYPE
from tests.support.examples import sample

VALUES = {"corners": "0,0 4,0 0,3.5", "joints": "a:-1..1 b:0..2.5", "entries": "Battery, Laser: *", "time": "7s",
          "hosts": "10.0.0.7/32 10.8.0.0/16", "bool": "true"}  # fmt: skip
RELEASED = [tuple(path.stem.rsplit("-", 1)) for path in sorted(FOLDER.glob("*.rv"))]  # names and versions


def another(parameter: Parameter) -> str:
    """Return a valid value that is not the default."""
    if parameter.kind in VALUES:
        return "false" if (parameter.kind, parameter.default) == ("bool", "true") else VALUES[parameter.kind]
    return next(
        value for value in (parameter.most, parameter.least) if float(value) != float(parameter.default)
    )


def made(preset: Preset, kinds: tuple[str, ...] = ()) -> Guard:
    """Return a guard with other topics and values than those of the preset."""
    types = dict(zip(preset.topics, kinds or (types[0] for types in preset.topics.values()), strict=True))
    topics = {name: f"/robot/{name}/goal" for name in preset.given_topics}
    values = {parameter.name: another(parameter) for parameter in preset.parameters}
    return Guard("mine", preset, topics, types, values)


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_guard_with_any_topics_types_and_values_is_current(preset: Preset) -> None:
    for kinds in product(*preset.topics.values()):
        chosen = tuple(kind.replace(ANY_TYPE, "my_robot/State") for kind in kinds)
        text = text_of(made(preset, chosen))
        assert origin_of(text) == "current", chosen
        assert origin_of(text + "\norder mine < other;\n") == "current"
    assert origin_of(preset.text) == "current"


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_text_that_was_changed_is_not_the_presets(preset: Preset) -> None:
    """Each character of the rules counts, and so do comments: the meaning of a change is not judged."""
    text = text_of(made(preset))
    places = re.finditer(r"<=|<|>=|>|==|!|\bSTOP\b|\bDROP\b|\btrue\b|;$", text, re.MULTILINE)
    for found in sample(places):
        for other in ("", "== 0 || 1e9 >"):
            assert origin_of(text[: found.start()] + other + text[found.end() :]) == "changed"
    for other in (
        text + "\n// more\n",
        text + "\nother() { }\n",
        text.replace(" given {", " given  {", 1),
        text + " ",
    ):
        assert origin_of(other) == "changed"


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_value_beyond_its_range_or_without_a_place_is_a_change(preset: Preset) -> None:
    text = text_of(made(preset))
    for each in preset.parameters:
        if each.most:
            assert origin_of(re.sub(rf"( {each.name} = )[^ ;]+", r"\g<1>1e9", text, count=1)) == "changed"
    for other in ("unknown = 1;", "command = cmd;", "command = /c std_msgs/Empty;"):
        assert origin_of(text.replace("\n}\n", f"\n    {other}\n}}\n", 1)) == "changed"


@pytest.mark.parametrize(("name", "version"), [
    ("separation", 2), ("zone", 1), ("joints", 2), ("joints", 3), ("hold_to_run", 1), ("ready", 2),
])  # fmt: skip
def test_a_guard_of_an_earlier_version_is_upgraded_with_its_values(name: str, version: int) -> None:
    base = released.released_preset(name, version)
    for guard in (made(base), replace(made(base), values={})):
        text = text_of(guard)
        assert origin_of(text) == "older"
        new = upgrade_of(text, {}, [TopicFacts(topic, kind, (), ()) for topic, kind in old_types(text)])
        assert origin_of(new.text) == "current" and topics_in(new.text) == topics_in(text)
        assert values_in(new.text).items() >= values_in(text).items()


@pytest.mark.parametrize(("old", "new", "version"), [("enable", "hold_to_run", 1), ("arm", "ready", 2)])
def test_a_preset_with_its_old_name_is_the_same_preset(old: str, new: str, version: int) -> None:
    text = text_of(made(released.released_preset(new, version)))
    preset = preset_of(text)
    assert text.startswith(f"preset {old} {version} as mine")
    assert preset is not None and preset.name == new and preset_named(old) is PRESETS[new]
    changed = with_values(text, {"silent": "0.45"})
    assert changed.startswith(f"preset {old} {version} as mine") and origin_of(changed) == "older"
    assert upgrade_of(changed, {}, ()).text.startswith(f"preset {new} {PRESETS[new].version} as mine")


def test_an_upgrade_takes_a_further_topic_that_no_node_has_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    text = re.sub(r"\n    topic state [^\n]*", "", released.released_preset("joints", 2).text)
    base = replace(PRESETS["joints"], source=text)
    for module in (released, upgrades):
        monkeypatch.setattr(module, "released_preset", lambda _name, _version: base)
    with pytest.raises(GuardError, match="joints needs a topic for state: give --topic state=TOPIC"):
        upgrade_of(base.text, {}, [])
    new = upgrade_of(base.text, {}, [], {"state": "/arm/joint_states"})
    assert topics_in(new.text)["state"] == "/arm/joint_states"
    other = TopicFacts("/arm/joint_states", "nav_msgs/Odometry", (), ())
    with pytest.raises(GuardError, match="has the type nav_msgs/Odometry on this robot"):
        upgrade_of(base.text, {}, [other], {"state": "/arm/joint_states"})


def old_types(text: str) -> Iterator[tuple[str, str]]:
    for name, topic in topics_in(text).items():
        if kind := types_in(text).get(name):
            yield topic, kind


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_preset_that_differs_from_its_released_text_has_a_higher_version(preset: Preset) -> None:
    versions = [int(version) for name, version in RELEASED if name == preset.name]
    if preset.version in versions:
        assert preset.text == released.released_preset(preset.name, preset.version).text
    else:
        assert preset.version > max(versions, default=0)


@pytest.fixture
def older(monkeypatch: pytest.MonkeyPatch) -> Iterator[Preset]:
    """Release the present `speed`, and make it version 1000, with another range, default and parameter."""
    now = PRESETS["speed"]
    text = now.text.replace(f"preset speed {now.version};", "preset speed 1000;")
    text = text.replace("double vMax = 0.5 m/s in 0..50;", "double vMax = 0.3 m/s in 0..2;", 1)
    text = text.replace("double wMax =", "double turn =", 1) + "\n"
    assert text.count("0..2;") == 1
    new = replace(now, source=text)
    monkeypatch.setitem(PRESETS, "speed", new)
    monkeypatch.setattr(released, "released_preset", lambda _name, _version: now)
    monkeypatch.setattr(upgrades, "released_preset", lambda _name, _version: now)
    origin_of.cache_clear()
    yield now
    origin_of.cache_clear()


@pytest.mark.parametrize("kind", PRESETS["speed"].topics["command"])
def test_an_upgrade_keeps_name_topics_types_values_and_order(older: Preset, kind: str) -> None:
    guard = Guard("cap", older, {"command": "/base/cmd"}, {"command": kind}, {"vMax": "1.5", "aMax": "2"})
    text = text_of(guard) + "\norder fence < cap;\n"
    assert origin_of(text) == "older"
    new = upgrade_of(text, {"vMax": "1.25"}, [])
    assert origin_of(new.text) == "current" and new.text.endswith("\norder fence < cap;\n")
    assert (topics_in(new.text), types_in(new.text)) == ({"command": "/base/cmd"}, {"command": kind})
    assert (values_in(new.text)["vMax"], values_in(new.text)["aMax"]) == ("1.25", "2")
    assert new.changed == {"wMax": ["1", ""], "turn": ["", "1"]}
    assert "vMax=1.25 is kept; the default is now 0.3" in new.warnings


def test_a_value_that_cannot_be_kept_is_named(older: Preset) -> None:
    types = {"command": "geometry_msgs/Twist"}
    for values, why in (
        ({"vMax": "5"}, "vMax=5 cannot be kept: speed 1000 does not allow it: vMax=5 is outside of 0..2 m/s"),
        ({"wMax": "3"}, "wMax=3 cannot be kept: speed 1000 has no such value"),
    ):
        with pytest.raises(GuardError, match=re.escape(why)):
            upgrade_of(text_of(Guard("cap", older, types=types, values=values)), {}, [])
    for text, why in (
        (text_of(Guard("cap", older, types=types)).replace("clamp", "fmin", 1), "was changed"),
        (text_of(Guard("cap", PRESETS["speed"], types=types)), "has the present version"),
    ):
        with pytest.raises(GuardError, match=why):
            upgrade_of(text, {}, [])


def test_a_release_is_refused_until_its_presets_are_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(released_presets, "FOLDER", tmp_path)
    monkeypatch.setattr(released_presets, "PRESETS", {name: PRESETS[name] for name in ("sane", "rate")})
    with pytest.raises(SystemExit, match="sane, rate: run python -m"):
        released_presets.main(["--check"])
    released_presets.main([])
    released_presets.main(["--check"])
    (tmp_path / f"rate-{PRESETS['rate'].version}.rv").write_text("another")
    for arguments in (["--check"], []):
        with pytest.raises(SystemExit, match="is released: give the changed preset rate another version"):
            released_presets.main(arguments)
