"""The Python module that is being generated: its lines, the names it may use, and the sites faults are told by."""

import struct
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from appliance.rosmop.positions import Position
from appliance.rosmop.runtime.context import FaultError

FILENAME = "<compiled specification>"
MAX_LINES = 200_000


@dataclass(frozen=True)
class Site:
    """A place in the text that generated code belongs to, and the variables whose values explain a fault there.

    `variables` are (name in the text, name in the code, how to show a value, whether a value never changes in place).
    """

    position: Position
    variables: tuple[tuple[str, str, Callable[[Any], object], bool], ...] = ()

    @property
    def compared(self) -> list[tuple[str, str, Callable[[Any], object], bool]]:
        """The variables of a condition that are told when it was met: they are still what they were then."""
        return [variable for variable in self.variables if variable[3]]


class TooComplexError(Exception):
    """The generated code is more than the Python compiler takes."""


class Module:
    """Lines of source, each with its site; and the namespace the code will run in."""

    def __init__(self) -> None:
        self.sites: list[Site] = []
        self.namespace: dict[str, Any] = {"__builtins__": {}}
        self._lines: list[str] = []
        self._line_sites: list[int] = []
        self._names = 0
        self._structs: dict[tuple[str, str], str] = {}
        self._functions: set[str] = set()

    def fresh(self, prefix: str) -> str:
        """A name that nothing else has."""
        self._names += 1
        return f"{prefix}{self._names}"

    def site(self, site: Site) -> int:
        """The number of a site."""
        self.sites.append(site)
        return len(self.sites) - 1

    def use(self, value: Any, prefix: str = "x") -> str:
        """A name for a value from outside."""
        name = self.fresh(prefix)
        self.namespace[name] = value
        return name

    def struct(self, code: str, method: str) -> str:
        """A name for `Struct(code).method`."""
        key = (code, method)
        if key not in self._structs:
            self._structs[key] = self.use(getattr(struct.Struct(code), method), "s")
        return self._structs[key]

    def add(self, lines: list[tuple[str, int]]) -> None:
        """Append lines with their sites (-1: none): those of one function."""
        head = lines[0][0] if lines else ""
        if head.startswith("def "):
            self._functions.add(head[4 : head.index("(")])
        for line, site in lines:
            self._lines.append(line)
            self._line_sites.append(site)

    def has(self, name: str) -> bool:
        """Whether there is a function of this name."""
        return name in self._functions

    @property
    def next_line(self) -> int:
        """The number of the line that is added next."""
        return len(self._lines) + 1

    def place_of(self, error: Exception) -> tuple[int, Mapping[str, Any]]:
        """The site that an exception of the code belongs to (-1: none), and the local variables there."""
        frames = list(_frames(error))
        line, variables = frames[-1] if frames else (0, {})
        if isinstance(error, FaultError) and error.site >= 0:
            return error.site, variables
        return self._line_sites[line - 1] if line else -1, variables

    def has_begun(self, line: int, error: Exception) -> bool:
        """Whether the function of the code that was called had come to this line when the exception came."""
        return next((at >= line for at, _ in _frames(error)), False)

    @property
    def source(self) -> str:
        """The source, for tests and for the curious."""
        return "\n".join(self._lines) + "\n"

    def run(self) -> dict[str, Any]:
        """Compile and execute the module; returns its namespace. Raises `TooComplexError`."""
        if len(self._lines) > MAX_LINES:
            raise TooComplexError(f"{len(self._lines)} lines of code")
        try:
            code = compile(self.source, FILENAME, "exec", dont_inherit=True, optimize=0)
        except (SyntaxError, RecursionError, MemoryError, OverflowError) as error:
            raise TooComplexError(str(error)) from None
        exec(code, self.namespace)  # noqa: S102  our own code: see the head of this package
        return self.namespace


def _frames(error: Exception) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """The lines of the code that an exception has come through, from the outermost, with their local variables."""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if frame.f_code.co_filename == FILENAME:
            yield line, frame.f_locals


class Lines:
    """The body of a function while it is written: indentation, and the site of the current statement."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, int]] = []
        self.depth = 1
        self.site = -1

    def add(self, line: str) -> None:
        """Append a line at the current depth."""
        self.lines.append(("    " * self.depth + line, self.site))

    def extend(self, lines: list[str]) -> None:
        """Append lines at the current depth."""
        for line in lines:
            self.add(line)
