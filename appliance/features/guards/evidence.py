"""Compute the digest that binds a guard to its preset, its text and its values.

The same digest in `rosrv guard list --json` at two times means the same guard. The digest of a preset's text is also on
the evidence page, beside what was proved and simulated of this text.
"""

import hashlib
import json
from collections.abc import Mapping

from appliance.features.guards.presets import Preset
from rosmop.form.switch_words import without_file_switch

_DIGITS = 16


def text_digest(text: str) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a text, such as a preset as it is shipped."""
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def guard_digest(preset: Preset, text: str, values: Mapping[str, str]) -> str:
    """Return the digest of a guard with this text, made from the preset, and with these values in force."""
    plain = without_file_switch(text)  # on or off, it is the same guard
    bound = json.dumps([preset.name, text_digest(preset.text), plain, sorted(values.items())])
    return text_digest(bound)
