"""Compare a guard with its preset, and with all released versions of it, whose texts are in `monitors/guards/released`.

A release adds the present versions: `python -m distribution.released_presets`.
"""

import functools
from dataclasses import replace
from typing import Literal

from appliance.features.guards import presets
from appliance.features.guards.presets import PRESETS, Guard, GuardError, Preset, head_of
from rosmop.form.switch_words import file_switch

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
        base = preset if loaded.version == preset.version else released_preset(loaded.name, loaded.version)
        unchanged = _is_of(own, base)
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


def released_preset(name: str, version: int) -> Preset:
    """Return the released version of a preset. Raises `FileNotFoundError`."""
    text = (FOLDER / f"{name}-{version}.rv").read_text(encoding="utf-8")
    return replace(PRESETS[name], source=text)


def without_order(text: str) -> str:
    """Return the text without the `order` statements that `rosrv guard new` of 0.4 wrote behind it."""
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
