"""Read the tables of texts and results in the `*.txt` files beside the tests.

    # The title of a section
    | the text around each source of the section, one or more lines,
    | where … is the source, and ‥ its lines that begin with `+`
    a source
    of one line or several
    ==> a line of its result
    ==> and another one
    a short source ==> and its result

An empty line ends a source without a result. A test has its file and line as its id.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ARROW = "==>"


@dataclass(frozen=True)
class Case:
    place: str
    section: str
    frame: str
    source: str
    beside: str
    expected: tuple[str, ...]

    @property
    def text(self) -> str:
        return self.frame.replace("‥", self.beside).replace("…", self.source)


def cases(path: Path) -> Iterator[Case]:
    section, frame, begins = "", list[str](), 0
    source, beside, expected = list[str](), list[str](), list[str]()

    def case() -> Case:
        around, text, more = ("\n".join(lines) for lines in (frame or ["…"], source, beside))
        return Case(f"{path.name}:{begins}", section, around, text, more, tuple(expected))

    for number, line in enumerate([*path.read_text(encoding="utf-8").split("\n"), ""], 1):
        before, arrow, result = line.rpartition(ARROW)
        if (expected and before) or (not arrow and (source or expected) and (expected or not line)):
            yield case()
            source, beside, expected = [], [], []
        if line.startswith("# "):
            section, frame = line[2:], []
        elif line.startswith("| "):
            frame.append(line[2:])
        elif line.startswith("+"):
            begins = begins if beside or source else number
            beside.append(line[1:])
        elif arrow:
            begins = begins if beside or source else number
            source += [before.removesuffix(" ")] * bool(before)
            expected.append(result[1:])
        elif line:
            begins = begins if beside or source else number
            source.append(line)


def table(path: Path) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("case", list(cases(path)), ids=lambda case: case.place)
