"""Read transcripts: a line at the margin is an action, and the indented lines below it are its effects.

The title of each, after `# `, states its promise. An empty line ends it.
"""

from collections.abc import Awaitable, Callable
from itertools import groupby
from pathlib import Path


def transcripts(file: Path) -> dict[str, list[str]]:
    texts = file.read_text(encoding="utf-8").strip().removeprefix("# ").split("\n\n# ")
    return {title: lines for title, *lines in (text.splitlines() for text in texts)}


async def played(written: list[str], say: Callable[[str], Awaitable[list[str]]]) -> list[str]:
    lines: list[str] = []
    for action in written:
        if not action.startswith(" "):
            effects = [(effect, len(list(equal))) for effect, equal in groupby(await say(action))]
            lines += [
                action,
                *(f"    {effect}{f' ({many} times)' if many > 1 else ''}" for effect, many in effects),
            ]
    return lines
