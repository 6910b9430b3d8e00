"""Pages, docstrings and comments are written in plain English: one word for one thing, and none of the habits below.

`test_source_rules.py` checks Python files. Code, quoted output and generated pages are left out.
"""

import ast
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
FOLDERS = (
    "appliance/", "rosmop/", "rosmop/tests/", "roswire/", "examples/", "benchmarks/", "distribution/", "fleet/",
    "tests/", "lab/",
)  # fmt: skip
GENERATED = ("metrics.md", "audit-events.md")
STRING_OR_COMMENT = re.compile(
    r'''"""(?:\\.|[^\\])*?"""|'{3}(?:\\.|[^\\])*?'{3}|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|[#][^\n]*''',
    re.DOTALL,
)
"""A string of Python, or a comment. Matching it is much faster than `tokenize`."""


class Habit(NamedTuple):
    pattern: str
    instead: str
    example: str


HABITS = (
    Habit(r"\banew\b", "again", "It is read anew."),
    Habit(r"\bamid\b", "while", "It was killed amid a write."),
    Habit(r"\b[Aa]t last\b", "finally", "At last it ends."),
    Habit(r"\bmend(?:s|ed|ing)?\b", "fix, repair", "The loop mends it."),
    Habit(r"\bstrangers?\b", "unknown host", "A stranger connects."),
    Habit(r"\bfallen\b(?! behind)", "compromised", "A fallen process keeps its rights."),
    Habit(r"\bwalls\b", "sandbox", "The walls of a process hold."),
    Habit(r"\bcalls? of the kernel\b", "system call", "It makes a call of the kernel."),
    Habit(r"\bby (?:it|them)sel(?:f|ves)\b", "automatically", "It goes back by itself."),
    Habit(r"(?<!there )(?<!There )\b(?:is|are|was|were) no (?!longer\b)", "is not a", "A group is no host."),
    Habit(
        r"\b(?:is|are|was|were|be|been|being) told\b",
        "gets, receives, is notified",
        "A node is told its list.",
    ),
    Habit(r"\bOn trial\b|\bon trial\b", "in shadow mode, with commit-confirm", "It is loaded on trial."),
    Habit(
        r"\bROSMaster\b|\bROS Master\b(?! API)",
        "ROS master; `rosmaster` for the program",
        "ROSMaster answers.",
    ),
    Habit(r"\b[Ww]hoever\b", "any host that, anyone who", "Whoever reaches it may call."),
    Habit(r"(?:^|[.:;|]\s+)(?:Who|That of|Those of|Of)\s(?![^.]*\?)", "the noun", "Who asks is recorded."),
    Habit(
        r"(?:^|; )(?:null|empty): ",
        ", or null if; by default,",
        "The port of an agent; null: it has none.",
    ),
    Habit(r", too\b(?! \w+ly)", "also", "It is recorded, too."),
    Habit(r"(?<!and )\balso (?:if|when|while|not)\b", "even if, not even", "It holds also if control dies."),
    Habit(
        r", the (?:oldest|newest|latest|most severe) first\b", "oldest first", "All doors, the oldest first."
    ),
    Habit(r"\btakes? long\b", "takes a long time", "A start may take long."),
    Habit(
        r"\b(?:nobody|everybody|anybody|somebody)\b",
        "the host, process or person",
        "It is granted to nobody.",
    ),
    Habit(r"(?:^|[.]\s+)What\s(?![^.?]*[?])", "the noun", "What is loaded survives."),
    Habit(r"\b(?:is|are) said\b", "is reported, printed", "It is said at start."),
    Habit(r"\b(?:held|holds?) (?:\w+ )?against\b", "compare with", "It is held against the formula."),
    Habit(r"\bput back\b", "restore, register again", "A node is put back."),
    Habit(r"\bbelongs? into\b", "belongs in", "It belongs into the policy."),
    Habit(
        r"\bmeanwhile\b(?!-)|\bMeanwhile\b",
        "in the meantime, while, since",
        "Its host was revoked meanwhile.",
    ),
    Habit(r"\bso many\b", "the number", "So it has so many slices."),
    Habit(
        r"\bnode proxy\b|\bnode proxies\b|\bouter face\b|\binner face\b", "proxy endpoint", "The outer face."
    ),
    Habit(r"\bstands? (?:in|at|on|already)\b", "is in, uses, is defined", "The key stands in section A."),
    Habit(r"\bcomes? home\b", "is copied back", "The state has to come home."),
    Habit(r"\bgood for nothing\b", "invalid, useless", "The token is good for nothing."),
    Habit(r"\bwithout a word\b", "without an answer, without a message", "It is closed without a word."),
    Habit(r"\bhe\b|\bhis\b|\bhim\b", "they, the host, the process", "An operator signs his order."),
)

CODE = re.compile(r"```.*?```|<!--.*?-->|`[^`\n]*`|\]\([^)]*\)", re.DOTALL)
_ANY = re.compile("|".join(f"(?:{habit.pattern})" for habit in HABITS), re.MULTILINE)


def bad_habits(prose: str) -> Iterator[tuple[int, str]]:
    prose = CODE.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), prose)
    if _ANY.search(prose):
        for habit in HABITS:
            for hit in re.finditer(habit.pattern, prose, re.MULTILINE):
                yield prose.count("\n", 0, hit.end()) + 1, f"{hit[0].strip()!r}: write {habit.instead!r}"


def said_in(source: str, nodes: Sequence[ast.AST]) -> str:
    lines = [""] * (source.count("\n") + 2)
    for node in nodes:
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) if name.startswith("test_"):
                lines[node.lineno] += f"{name.removeprefix('test_').replace('_', ' ').capitalize()}."
            case ast.Expr(value=ast.Constant(value=str(text))):
                for offset, line in enumerate(text.split("\n")):
                    lines[node.lineno + offset] += line.strip()
    number = position = 0
    for token in STRING_OR_COMMENT.finditer(source):
        if token[0][0] == "#":
            number += source.count("\n", position, token.start())
            position = token.start()
            lines[number + 1] += f" {token[0].lstrip('# ')}"
    return "\n".join(lines[1:])


def test_no_page_has_a_bad_habit() -> None:
    folders = [path for name in ("docs/", *FOLDERS) for path in sorted((ROOT / name).rglob("*.md"))]
    found = [
        f"{page.relative_to(ROOT)}:{line}: {what}"
        for page in {ROOT / name for name in PAGES}.union(folders)
        if page.name not in GENERATED
        for line, what in bad_habits(re.sub(r"^ {4,}\S.*$", "", page.read_text(), flags=re.MULTILINE))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("habit", HABITS, ids=lambda habit: habit.instead)
def test_each_pattern_finds_its_example(habit: Habit) -> None:
    assert any(habit.instead in what for _line, what in bad_habits(habit.example))
