"""Count the interfaces of the program: `python -m distribution.interfaces`, and `… NAME` for one count's members.

Lines are not counted here: a useful change of 25 lines changes none of these numbers. `distribution/sizes.py` measures
lines, at a release. `tests/unit/test_interfaces.py` fails if a count exceeds its limit.
"""

import ast
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from distribution.checkout import ROOT

_NAMED = "doors, approvals, authority, sso, guards, standby or recorder"
_CERTIFICATES = ("appliance/ipsec/", "appliance/hosts/")  # an authority there is a certificate authority
_FEATURE_WORDS = re.compile(
    r"doors?|approvals?|approved?|authority|sso|sign_ons?|guards?|standby|recorder|recordings?"
)
_TABLES = ("appliance.features.feature", "appliance.features.table", "appliance.features.view",
           "appliance.features.views", "appliance.features.parts")  # fmt: skip
_MODULE_NAME = re.compile(r"appliance(\.\w+)+(?=:|$)")
_LONG_HELPER = 40  # lines
_MANY_ATTRIBUTES = 15


class Count(NamedTuple):
    """A count, with the most that it may be, and its goal."""

    name: str
    what: str
    limit: int
    goal: int
    members: Callable[[], list[str]]


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


@cache
def _nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(_tree(path)))


def _product() -> Iterator[Path]:
    for folder in ("appliance", "roswire", "rosmop", "fleet/rosrv_fleet"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            if not path.is_relative_to(ROOT / "rosmop" / "tests"):
                yield path


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def _modules() -> Mapping[str, Path]:
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in (ROOT / "appliance").rglob("*.py")
    }


def _direct_imports(path: Path) -> set[str]:
    """Return the modules of the appliance that a file names: in imports, also late ones, and in strings."""
    modules, names = _modules(), set()
    for node in _nodes(path):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            members = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {member if member in modules else node.module for member in members}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names |= {match[0] for match in (_MODULE_NAME.match(node.value),) if match}
    return names & modules.keys()


@cache
def _reexported(module: str) -> frozenset[str]:
    """Return the core modules whose names a module passes on: those of `__all__`, or `import x as x`."""
    tree = _tree(_modules()[module])
    passed_on: set[str] = set()
    public = {
        element.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        and any(getattr(target, "id", "") == "__all__" for target in node.targets)
        for element in getattr(node.value, "elts", ())
        if isinstance(element, ast.Constant)
    }
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module in _modules():
            for alias in node.names:
                if alias.name in public or alias.asname == alias.name:
                    passed_on.add(node.module)
    return frozenset(passed_on | {deeper for inner in passed_on for deeper in _reexported(inner)})


def modules_that_features_import() -> list[str]:
    imported: set[str] = set()
    for path in (ROOT / "appliance" / "features").rglob("*.py"):
        for module in _direct_imports(path):
            imported |= {module} | _reexported(module)
    return sorted(one for one in imported if not one.startswith("appliance.features."))


def names_of_a_feature() -> list[str]:
    tree = _tree(ROOT / "appliance/features/feature.py")
    return [
        f"{node.name}.{field.target.id}"
        for node in tree.body
        if isinstance(node, ast.ClassDef) and node.name in {"Feature", "FeaturePart"}
        for field in node.body
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
    ]


def phases_of_a_feature() -> list[str]:
    phases = ("make", "operate", "keep", "inherit", "may_start")
    return [name for name in phases if f"Feature.{name}" in names_of_a_feature()]


def late_imports() -> list[str]:
    """Return the imports inside of functions."""
    imports: list[str] = []
    for path in _product():
        inside = {
            node.lineno
            for function in _nodes(path)
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
            for node in ast.walk(function)
            if isinstance(node, ast.Import | ast.ImportFrom)
        }
        imports += [f"{_name(path)}:{line}" for line in sorted(inside)]
    return imports


def core_files_that_name_features() -> list[str]:
    """Return the core files with an identifier that names one of seven features."""
    return [
        _name(path) for path in _product() if _is_core(path) and any(map(_is_a_feature, _identifiers(path)))
    ]


def _is_core(path: Path) -> bool:
    name = _name(path)
    return name.startswith("appliance/") and not name.startswith(("appliance/features/", *_CERTIFICATES))


def _identifiers(path: Path) -> Iterator[str]:
    for node in _nodes(path):
        match node:
            case (
                ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.keyword(arg=str(name))
            ):
                yield name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.alias(name=name):
                yield from name.split(".")


def _is_a_feature(identifier: str) -> bool:
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", identifier).lower()
    return any(_FEATURE_WORDS.fullmatch(part) for part in (words, *words.split("_")))


def walkers_of_the_audit_log() -> list[str]:
    """Return the modules, besides those that write the log, whose SQL reads its records."""
    query = re.compile(r"\bFROM record\b")
    return [
        _name(path)
        for path in _product()
        if not path.is_relative_to(ROOT / "appliance/audit/log")
        and query.search(path.read_text(encoding="utf-8"))
    ]


def files_of_a_registration() -> list[str]:
    """Return the files on the architecture's page; a test with real parts compares them with a profile."""
    page = (ROOT / "docs/dev/architecture.md").read_text(encoding="utf-8")
    section = page.split("\n## The path of one registerPublisher", 1)[1].split("\n**Levels", 1)[0]
    return [
        path
        for row in section.splitlines()
        if row.startswith("| ")
        for path in re.findall(r"`([\w/]+\.py)`", row)
    ]


def classes_with_many_attributes() -> list[str]:
    return [
        f"{_name(path)}: {node.name} {number}"
        for path in _product()
        for node in _nodes(path)
        if isinstance(node, ast.ClassDef) and (number := len(_attributes(node))) >= _MANY_ATTRIBUTES
    ]


def _attributes(node: ast.ClassDef) -> set[str]:
    """Return the attributes that a class's methods set: its state, without the fields of plain data."""
    names: set[str] = set()
    for inner in ast.walk(node):
        if (
            isinstance(inner, ast.Attribute)
            and isinstance(inner.ctx, ast.Store)
            and isinstance(inner.value, ast.Name)
            and inner.value.id == "self"
        ):
            names.add(inner.attr)
    return names


def uses_of_any() -> list[str]:
    return [
        f"{_name(path)}:{node.lineno}"
        for path in _product()
        for node in _nodes(path)
        if isinstance(node, ast.Name) and node.id == "Any"
    ]


def long_helpers_in_tests() -> list[str]:
    """Return the functions of more than 40 lines that a test's body calls, as `file: function lines`."""
    helpers: dict[str, list[tuple[str, int]]] = {}
    for path, node in _functions_of_tests():
        length = (node.end_lineno or node.lineno) - node.lineno + 1
        if length > _LONG_HELPER and not node.name.startswith("test_"):
            helpers.setdefault(node.name, []).append((_name(path), length))
    found = set()
    for path, node in _functions_of_tests():
        if node.name.startswith("test_"):
            called = {
                getattr(call.func, "id", getattr(call.func, "attr", ""))
                for call in ast.walk(node)
                if isinstance(call, ast.Call)
            }
            for name in called & helpers.keys():
                own = [row for row in helpers[name] if row[0] == _name(path)]
                shared = [
                    row
                    for row in helpers[name]
                    if "/support/" in row[0] or row[0].rsplit("/", 1)[0] == _name(path).rsplit("/", 1)[0]
                ]
                for file, length in own or shared:
                    found.add(f"{file}: {name} {length}")
    return sorted(found)


def _functions_of_tests() -> Iterator[tuple[Path, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for folder in ("tests", "rosmop/tests"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in _nodes(path):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    yield path, node


COUNTS = (
    Count("imported", "core modules that features import", 221, 15, modules_that_features_import),
    Count("names", "names of `Feature` and of its part", 36, 10, names_of_a_feature),
    Count("phases", "phases of a feature in control", 5, 1, phases_of_a_feature),
    Count("late", "late imports in product code", 97, 10, late_imports),
    Count("spoken", f"core files with an identifier of {_NAMED}", 43, 10, core_files_that_name_features),
    Count("walkers", "modules with SQL of their own that reads the audit log", 10, 3, walkers_of_the_audit_log),
    Count("registration", "files of one registerPublisher", 50, 48, files_of_a_registration),
    Count("wide", "classes with 15 attributes or more", 48, 36, classes_with_many_attributes),
    Count("any", "uses of `Any` in product code", 1360, 900, uses_of_any),
    Count("helpers", "helpers of more than 40 lines that a test's body calls", 7, 0, long_helpers_in_tests),
)  # fmt: skip


def main(arguments: list[str]) -> int:
    """Print the counts, or the members of the counts that the arguments name."""
    known = {count.name: count for count in COUNTS}
    for name in arguments:
        if name not in known:
            sys.stderr.write(f"interfaces: {name!r} is not a count; use one of: {', '.join(known)}\n")
            return 2
        for member, number in Counter(known[name].members()).items():
            sys.stdout.write(f"{member}{f' ({number})' if number > 1 else ''}\n")
    if not arguments:
        sys.stdout.write(f"{'name':<14}{'now':>6}{'limit':>7}{'goal':>6}  count\n")
        for count in COUNTS:
            row = f"{count.name:<14}{len(count.members()):>6}{count.limit:>7}{count.goal:>6}  {count.what}\n"
            sys.stdout.write(row)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
