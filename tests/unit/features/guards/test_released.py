"""Guards of released versions are recognised by their texts, and upgraded with their values."""

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

from appliance.features.guards import released, upgrades
from appliance.features.guards.message_types import ANY_TYPE
from appliance.features.guards.presets import (
    PRESETS,
    Guard,
    GuardError,
    Parameter,
    Preset,
    preset_of,
    text_of,
    topics_in,
    types_in,
    values_in,
    with_values,
)
from appliance.features.guards.released import FOLDER, origin_of
from appliance.features.guards.upgrades import upgraded
from distribution import released_presets
from distribution.released_presets import lines_of
from tests.support.examples import sample

VALUES = {"corners": "0,0 4,0 0,3.5", "joints": "a:-1..1 b:0..2.5", "time": "7s", "hosts": "10.0.0.7/32 10.8.0.0/16",
          "bool": "true"}  # fmt: skip
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
    types = dict(
        zip(preset.topics, kinds or (next(iter(rows)) for rows in preset.topics.values()), strict=True)
    )
    topics = {name: f"/robot/{name}/goal" for name in preset.given_topics}
    values = {each.name: another(each) for each in preset.parameters}
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
        text.replace(") given {", ") given  {", 1) + " ",
    ):
        assert origin_of(other) == "changed"


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_value_beyond_its_range_or_in_another_place_is_a_change(preset: Preset) -> None:
    text = text_of(made(preset))
    for each in preset.parameters:
        if each.most:
            beyond = re.sub(rf"( {each.name} = )[^ ;]+", r"\g<1>1e9", text, count=1)
            assert origin_of(beyond) == "changed"
            inner = text.replace("} {\n", f"}} {{\n    {each.kind} {each.name} = {each.most};\n", 1)
            assert origin_of(inner) == "changed"
    for name, topic in topics_in(text).items():
        assert origin_of(text.replace(f"{name}={topic}", f"{name}=/another", 1)) == "changed"


@pytest.mark.parametrize(("name", "version"), RELEASED)
def test_a_guard_of_a_released_version_is_recognised(name: str, version: str) -> None:
    """Also after `message_types.py` has changed: the rows of the release are those of its texts."""
    old = released.released(name, int(version))
    line, _, rest = text_of(replace(made(old), types={})).partition("\n")
    for topic, kind in types_in(old.text).items():
        line = re.sub(rf"\b({topic}=[^ ,]+)", rf"\g<1> {kind}", line)
    text = f"{line}\n{rest}"
    assert origin_of(text) == ("current" if int(version) == PRESETS[name].version else "older")
    assert origin_of(text.replace("(", "( ", 1)) == "changed"
    guard = preset_of(text)
    assert guard is not None and guard.version == int(version)
    for each in guard.parameters:
        if each.most:
            assert f" {each.name} = {each.least}" in with_values(text, {each.name: each.least})


def test_the_table_of_released_texts_has_each_version_and_no_other() -> None:
    there = {(name, str(version)) for name in PRESETS for version in released.versions_of(name)}
    assert there == {*RELEASED}


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_preset_that_differs_from_its_released_text_has_a_higher_version(preset: Preset) -> None:
    versions = [int(version) for name, version in RELEASED if name == preset.name]
    if preset.version in versions:
        assert preset.text == released.released(preset.name, preset.version).text
    else:
        assert preset.version > max(versions, default=0)
    types = {line.split(" ", 3)[3] for line in lines_of(preset)}
    assert len(types) == len([*product(*preset.topics.values())])


@pytest.fixture
def older(monkeypatch: pytest.MonkeyPatch) -> Iterator[Preset]:
    """Release the present `speed`, and make it version 1000, with another range, default and parameter."""
    now = PRESETS["speed"]
    text = now.text.replace(f"// preset speed {now.version}:", "// preset speed 1000:")
    text = text.replace("double vMax = 0.5 m/s in 0..50;", "double vMax = 0.3 m/s in 0..2;", 1)
    text = text.replace("double wMax =", "double turn =", 1) + "\n"
    assert text.count("0..2;") == 1
    new = replace(now, source=text)
    monkeypatch.setitem(PRESETS, "speed", new)
    rows = {
        line.split()[0]: dict(pair.split("=") for pair in line.split()[3:])
        for line in lines_of(replace(now, source=now.text))
    }
    monkeypatch.setattr(released, "versions_of", lambda _name: {now.version: rows})
    monkeypatch.setattr(released, "released", lambda _name, _version: now)
    monkeypatch.setattr(upgrades, "released", lambda _name, _version: now)
    origin_of.cache_clear()
    yield now
    origin_of.cache_clear()


@pytest.mark.parametrize("kind", PRESETS["speed"].topics["command"])
def test_an_upgrade_keeps_name_topics_types_values_and_order(older: Preset, kind: str) -> None:
    guard = Guard("cap", older, {"command": "/base/cmd"}, {"command": kind}, {"vMax": "1.5", "aMax": "2"})
    text = text_of(guard) + "\norder fence < cap;\n"
    assert origin_of(text) == "older"
    new = upgraded(text, {"vMax": "1.25"}, [])
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
            upgraded(text_of(Guard("cap", older, types=types, values=values)), {}, [])
    for text, why in (
        (text_of(Guard("cap", older, types=types)).replace("clamp", "fmin", 1), "was changed"),
        (text_of(Guard("cap", PRESETS["speed"], types=types)), "has the present version"),
    ):
        with pytest.raises(GuardError, match=why):
            upgraded(text, {}, [])


def test_a_release_is_refused_until_its_presets_are_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shutil.copytree(FOLDER, tmp_path / "released")
    monkeypatch.setattr(released_presets, "FOLDER", tmp_path / "released")
    monkeypatch.setattr(released_presets, "PRESETS", {name: PRESETS[name] for name in ("sane", "rate")})
    table = tmp_path / "released" / "texts.sha256"
    for name in ("sane", "rate"):
        (tmp_path / "released" / f"{name}-{PRESETS[name].version}.rv").unlink(missing_ok=True)
        wanted = [*released_presets.lines_of(PRESETS[name])]
        kept = [line for line in table.read_text().splitlines() if line not in wanted]
        table.write_text("\n".join(kept) + "\n")
    with pytest.raises(SystemExit, match="sane, rate: run python -m"):
        released_presets.main(["--check"])
    released_presets.main([])
    released_presets.main(["--check"])
