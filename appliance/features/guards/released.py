"""Compare a guard with its preset, and with all released versions of it, whose texts are in `monitors/guards/released`.

A release adds the present versions: `python -m distribution.released_presets`.
"""

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

from appliance.features.guards import old_form, presets
from appliance.features.guards.presets import PRESETS, Guard, GuardError, Preset, head_of
from rosmop.form.switch_words import file_switch
from rosmop.types.roles import ANY_TYPE

FOLDER = presets.FOLDER / "released"

Origin = Literal["current", "older", "changed"]
"""The text is that of the preset, or of a released version, with other topics and values; or it is any other text."""


@functools.lru_cache(maxsize=64)
def origin_of(text: str) -> Origin:
    """Return how the text of a guard relates to the preset in its `preset` statement."""
    loaded = presets.preset_of(text)
    if loaded is None:
        return "changed"
    own = without_order(text)
    preset = PRESETS[loaded.name]
    try:
        base = preset if loaded.version == preset.version else released(loaded.name, loaded.version)
        unchanged = _is_of(own, base) if text.startswith("preset ") else _is_of_old_form(own, base)
    except (FileNotFoundError, GuardError):
        return "changed"
    if not unchanged or loaded.version > preset.version:
        return "changed"
    return "older" if loaded.version < preset.version else "current"


def _is_of(text: str, base: Preset) -> bool:
    """Whether it is what the preset makes of its topics, types and values. Raises `GuardError`."""
    head = head_of(text)
    assert head is not None  # noqa: S101  the caller knows its preset
    values = {name: value for name, value in head.settings.items() if name not in base.given_topics}
    guard = Guard(head.name, base, presets.topics_in(text), presets.types_in(text), values, file_switch(text))
    return text in {presets.text_of(guard), base.text}


def released(name: str, version: int) -> Preset:
    """Return the released version of a preset. Raises `FileNotFoundError`."""
    text = (FOLDER / f"{name}-{version}.rv").read_text(encoding="utf-8")
    return replace(PRESETS[name], source=text)


def without_order(text: str) -> str:
    """Return the text without the `order` statements that `rosrv guard new` writes behind it."""
    lines = text.split("\n")
    while lines[-1:] == [""] and lines[-3:-2] == [""] and _is_order(lines[-2]):
        del lines[-3:-1]
    return "\n".join(lines)


def _is_order(line: str) -> bool:
    match line.removesuffix(";").split(" "):
        case ["order", first, "<", second]:
            return line.endswith(";") and first.isidentifier() and second.isidentifier()
    return False


def order_of(text: str) -> str:
    return text[len(without_order(text)) :]


# Guards of releases before 0.4, until 0.5


def _is_of_old_form(text: str, base: Preset) -> bool:
    hashes = versions_of(base.name).get(base.version, {})
    types = presets.types_in(text)
    named = PRESETS[base.name].topics
    any_types = {topic: ANY_TYPE for topic, kind in types.items() if kind not in named.get(topic, ())}
    general = text
    for topic in any_types:
        general = general.replace(f" {topic} {types[topic]} '{{}}'", f" {topic} {ANY_TYPE} '{{}}'")
    return (
        hashes.get(_hash_of(text, base)) == types or hashes.get(_hash_of(general, base)) == types | any_types
    )


def _hash_of(text: str, base: Preset) -> str:
    return hashlib.sha256(_plain(text, base).encode()).hexdigest()


def _plain(text: str, base: Preset) -> str:
    """Return a guard's text with the name, topics and values of a version of its preset, and without its first line.

    Raises `GuardError` for a value or topic that the version does not allow.
    """
    topics, values = presets.topics_in(text), presets.values_in(text)
    own = presets.preset_of(text) or base
    if any(own.given_topics.get(name) != topic for name, topic in topics.items()):
        raise GuardError("the first line names other topics than the text")
    known = (
        base.given_topics | {"cancel": f"{topics.get('command', '').removesuffix('/goal')}/cancel"} | topics
    )
    if any(known.get(name) != topic for name, topic in own.given_topics.items()):
        raise GuardError("the text has further topics")
    for name, value in values.items():
        base.parameter(name).checked(value)
    for name, topic in base.given_topics.items():
        text = old_form.with_topic(text, name, topic)
    text = old_form.with_topic(text, "cancel", "/cancel")
    defaults = presets.values_in(base.text)
    # The table was made with empty tables for a text without limits of joints.
    text = old_form.with_values(text, {name: defaults[name].replace("none", "") for name in values})
    return old_form.with_name(text, base.name).partition("\n")[2]


@functools.cache
def versions_of(name: str) -> Mapping[int, Mapping[str, Mapping[str, str]]]:
    """Return the types by hash, by version."""
    found: dict[int, dict[str, dict[str, str]]] = {}
    for line in (FOLDER / "texts.sha256").read_text(encoding="ascii").splitlines():
        digest, preset, version, *pairs = line.split()
        if preset == name:
            types = dict(pair.split("=", 1) for pair in pairs)
            found.setdefault(int(version), {})[digest] = types
    return found
