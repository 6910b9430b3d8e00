"""Show the changed lines of texts in audit records, which outlive the kept revisions."""

import difflib
from collections.abc import Mapping

LONGEST = 32 << 10
"""The most characters of the changed lines in one record."""

_MAX_LINES = 20_000  # of both texts: the comparison of longer ones takes too long
_CUT = "(more lines changed: compare the texts of both SHA-256)"


def changed_lines(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Return the changed lines of texts by their names, without lines around them, at most `LONGEST` characters."""
    lines: list[str] = []
    left = LONGEST
    for name in sorted(before.keys() | after.keys()):
        old, new = before.get(name, ""), after.get(name, "")
        if old == new:
            continue
        rows = (old.splitlines(), new.splitlines())
        if sum(map(len, rows)) > _MAX_LINES:
            return [*lines, f"--- {name}", _CUT]
        for line in difflib.unified_diff(*rows, name, name, n=0, lineterm=""):
            left -= len(line)
            if left < 0:
                return [*lines, _CUT]
            lines.append(line)
    return lines
