"""Compare the text of a guard with its preset, and with all released versions of it.

The texts of released versions are in `monitors/guards/released`. `texts.sha256` there has a line for each message type
that a version was made for, so a change of `message_types.py` changes nothing for guards in use. A release adds the
present versions: `python -m distribution.released_presets`.

    SHA-256 of the text with the preset's own name, topics and values, preset, version, topic=type …; `*`: any type
"""

import functools
import hashlib
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

from appliance.features.guards import presets
from appliance.features.guards.message_types import ANY_TYPE
from appliance.features.guards.presets import PRESETS, Guard, GuardError, Preset

FOLDER = presets.FOLDER / "released"
_ORDER = re.compile(r"(?:\norder \w++ < \w++;\n)++\Z")

Origin = Literal["current", "older", "changed"]
"""The text is that of the preset, or of a released version, with other topics and values; or it is any other text."""


@functools.lru_cache(maxsize=64)
def origin_of(text: str) -> Origin:
    """Return how the text of a guard relates to the preset in its first line."""
    loaded = presets.preset_of(text)
    if loaded is None:
        return "changed"
    preset = PRESETS[loaded.name]
    if loaded.version == preset.version and (
        _remade(text, preset) == without_order(text) or _as_shipped(text, preset)
    ):
        return "current"
    versions = versions_of(loaded.name)
    if loaded.version not in versions or loaded.version > preset.version:
        return "changed"
    base, hashes = released(loaded.name, loaded.version), versions[loaded.version]
    types = presets.types_in(text)
    any_types = {topic: ANY_TYPE for topic, kind in types.items() if kind not in preset.topics.get(topic, {})}
    general = text
    for topic in any_types:
        general = general.replace(f" {topic} {types[topic]} '{{}}'", f" {topic} {ANY_TYPE} '{{}}'")
    if hashes.get(hash_of(text, base)) != types and hashes.get(hash_of(general, base)) != types | any_types:
        return "changed"
    return "older" if loaded.version < preset.version else "current"


def released(name: str, version: int) -> Preset:
    """Return the released version of a preset. Raises `FileNotFoundError`."""
    text = (FOLDER / f"{name}-{version}.rv").read_text(encoding="utf-8")
    return replace(PRESETS[name], source=text)


def without_order(text: str) -> str:
    """Return the text without the `order` statements that `rosrv guard new` writes behind it."""
    return _ORDER.sub("", text)


def order_of(text: str) -> str:
    return text[len(without_order(text)) :]


def _remade(text: str, preset: Preset) -> str:
    try:
        guard = Guard(presets.name_in(text), preset, presets.topics_in(text), presets.types_in(text),
                      presets.values_in(text))  # fmt: skip
        return presets.text_of(guard)
    except GuardError:
        return ""


def _as_shipped(text: str, preset: Preset) -> bool:
    """Whether it is the file of the preset, whose events may be written in more lines than those of made texts."""
    own = hash_of(preset.text, preset)
    return presets.types_in(text) == presets.types_in(preset.text) and hash_of(text, preset) == own


def hash_of(text: str, base: Preset) -> str:
    """Return the SHA-256 of a text with the name, topics and values of the preset, or why one is not valid."""
    try:
        plain = presets.plain(without_order(text), base)
    except GuardError as error:
        return f"not valid: {error}"
    return hashlib.sha256(plain.encode()).hexdigest()


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
