"""How close conditions on numbers came: of each comparison the least distance of its sides, while true and while false.

The specifications are compiled once more; in the place of a comparison stands the call of a function that notes the
distance and gives the same answer (of integers up to 2^53), put into the tree and not into the text. Left alone are
conditions of loops (how close a counter came to its end says nothing) and what `when` looks at, which may not note it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from appliance.ros.definitions import Definitions
from appliance.rosmop.compile.specification import compile_files
from appliance.rosmop.engine import MonitorSet
from appliance.rosmop.positions import Position
from appliance.rosmop.syntax import tree
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.syntax.parser import parse

_COMPARED = frozenset({"<", "<=", ">", ">="})
_FAR = 1e308


@dataclass(frozen=True)
class Comparison:
    """A comparison of numbers in a specification, as it is written in its line."""

    specification: str
    position: Position
    line: str


class Compared:
    """Specifications whose comparisons of numbers are noted; `comparisons` in the order of the text.

    Raises `SpecificationError`.
    """

    def __init__(self, texts: Mapping[str, str], definitions: Definitions) -> None:
        MonitorSet.load(texts, definitions)  # errors are those of the text as it is
        self._definitions = definitions
        self._files = [parse(text, name) for name, text in texts.items()]
        candidates: list[Comparison] = []
        for file in self._files:
            lines = file.text.splitlines()
            for specification in file.specifications:
                candidates += [
                    Comparison(
                        specification.name, position, lines[position.line - 1].partition("//")[0].strip()
                    )
                    for position in _positions(specification)
                ]
        self.comparisons = self._numeric(candidates)

    def monitors(self) -> MonitorSet:
        """They, not started."""
        files = self._noting(self.comparisons)
        return MonitorSet(compile_files(files, self._definitions), files, "drop", lambda: lambda: False)

    def distances(self, monitors: MonitorSet) -> dict[tuple[Comparison, bool], float]:
        """The least distance so far of each comparison that came up, while it was true and while it was not."""
        found = {}
        for number, one in enumerate(self.comparisons):
            for truth in (True, False):
                distance = monitors.value(one.specification, _variable(number, truth))
                if distance < _FAR:
                    found[one, truth] = distance
        return found

    def _numeric(self, candidates: list[Comparison]) -> list[Comparison]:
        """Those of which both sides are numbers: they compile with a function that takes such."""
        try:
            compile_files(self._noting(candidates), self._definitions)
        except SpecificationError:
            half = len(candidates) // 2
            return self._numeric(candidates[:half]) + self._numeric(candidates[half:]) if half else []
        return candidates

    def _noting(self, chosen: list[Comparison]) -> list[tree.File]:
        return [
            replace(file, specifications=tuple(_noting(each, chosen) for each in file.specifications))
            for file in self._files
        ]


def _variable(number: int, truth: bool) -> str:
    return f"margin_{number}_{'true' if truth else 'false'}_"


def _positions(node: Any) -> list[Position]:
    """Where comparisons stand in a tree."""
    if isinstance(node, tuple):
        return [position for one in node for position in _positions(one)]
    if not isinstance(node, tree.Node):
        return []
    found = [node.position] if isinstance(node, tree.Binary) and node.operator in _COMPARED else []
    return found + [position for _, value in _parts(node) for position in _positions(value)]


def _parts(node: tree.Node) -> list[tuple[str, Any]]:
    """The parts of a tree that may have comparisons, by their names."""
    if isinstance(node, tree.While | tree.For | tree.RangeFor):
        return [("body", node.body)]
    left_alone = {"position", "trigger"}
    return [(each.name, getattr(node, each.name)) for each in fields(node) if each.name not in left_alone]


def _noting(node: tree.Specification, chosen: list[Comparison]) -> tree.Specification:
    """The specification with these of its comparisons noted, and the variables and functions for that."""
    own = {one.position: number for number, one in enumerate(chosen) if one.specification == node.name}
    functions: list[tree.Function] = []
    declarations: list[tree.Declaration] = []

    def noted(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(noted(one) for one in value)
        if not isinstance(value, tree.Node):
            return value
        changed = replace(value, **{name: noted(part) for name, part in _parts(value)})
        if (
            not isinstance(changed, tree.Binary)
            or changed.operator not in _COMPARED
            or changed.position not in own
        ):
            return changed
        number, operator = own[changed.position], changed.operator
        near, far = _variable(number, True), _variable(number, False)
        text = f"""m() {{ double {near} = {_FAR}; double {far} = {_FAR};
            bool margin_{number}_(double l, double r) {{ double d = fabs(l - r);
                if (l {operator} r) {{ if (d < {near}) {{ {near} = d; }} return true; }}
                if (d < {far}) {{ {far} = d; }} return false; }} }}"""
        (helper,) = parse(text, changed.position.file).specifications
        functions.extend(helper.functions)
        declarations.extend(helper.declarations)
        callee = tree.Name(changed.position, (f"margin_{number}_",))
        return tree.Call(changed.position, callee, (changed.left, changed.right))

    whole: tree.Specification = noted(node)
    return replace(
        whole,
        declarations=(*whole.declarations, *declarations),
        functions=(*functions, *whole.functions),
    )
