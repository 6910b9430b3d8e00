"""Read the steps of a page: a block is marked with its machine, and the block after it has the expected output.

    <!-- on: robot, stays -->

`fails` marks a block that ends with an error, `stays` one that keeps running. "…" in the output stands for any text.
"""

import re
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
_STEP = re.compile(
    r"<!-- on: (?P<host>\w+)(?:, (?P<how>\w+))? -->\n```sh\n(?P<script>.*?)```\n(?:```text\n(?P<shown>.*?)```\n)?",
    re.S,
)


@dataclass(frozen=True)
class Step:
    host: str
    how: str | None
    script: str
    shown: tuple[str, ...]


def steps(page: str) -> list[Step]:
    text = (DOCS / page).read_text()
    found = [
        Step(one["host"], one["how"], one["script"], tuple(_parts(one["shown"] or "")))
        for one in _STEP.finditer(text)
    ]
    assert text.count("```sh") == len(found)
    return found


def _parts(shown: str) -> list[str]:
    return [part.strip() for line in shown.splitlines() for part in line.split("…") if part.strip()]
