"""Read and change the word `on`, `shadow` or `off` in the `preset` statement at the beginning of a specification file.

It says how the monitor begins on an appliance that does not know it, such as one with a new state directory.
"""

import re
from typing import Literal, cast

Word = Literal["on", "shadow", "off"]
_STATEMENT = re.compile(
    r"(preset\s++\w++\s++\d++\s++as\s++(\w++))(?:\s++(on|shadow|off))?+(?=\s*+\{)", re.ASCII
)


def file_switch(text: str) -> Word | None:
    match = _STATEMENT.match(text)
    return cast("Word | None", match[3]) if match else None


def with_file_switch(text: str, word: Word | None) -> str | None:
    """Return the text with another word; None if it does not begin with a `preset` statement that can have one."""
    match = _STATEMENT.match(text)
    return match and f"{match[1]}{f' {word}' if word else ''}{text[match.end() :]}"


def without_file_switch(text: str) -> str:
    changed = with_file_switch(text, None)
    return text if changed is None else changed
