"""Count the interfaces of the program: `python -m distribution.interfaces`, and `… NAME` for one count's members.

Lines are not counted here: a useful change of 25 lines changes none of these numbers. `distribution/sizes.py` measures
lines, at a release. `tests/unit/test_interfaces.py` fails if a count exceeds its limit.
"""

import ast
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from distribution import counts
from distribution.checkout import ROOT
from distribution.counts import Count, functions, main, name_of, nodes, parsed, python_files, statements
from distribution.fact_cache import facts_of_files

_NAMED = "doors, approvals, authority, sso, guards, standby or recorder"
_CERTIFICATES = (
    "appliance/ipsec/",
    "appliance/hosts/",
    "appliance/control/assembly/active_role.py",
    "appliance/control/assembly/foundation.py",
    "appliance/control/assembly/host",
    "appliance/control/links/signer_requests.py",
    "appliance/channel/messages/signer_link.py",
    "appliance/channel/messages/tunnels.py",
    "appliance/formats/fleet_membership.py",
    "appliance/store/host_tables.py",
    "appliance/supervisor/service_gate.py",
)
"""The authority there is a certificate authority; other words for features count."""
_FEATURE_WORDS = re.compile(
    r"doors?|approvals?|approved?|authority|sso|sign_ons?|guards?|standby|recorder|recordings?"
)
_MODULE_NAME = re.compile(r"appliance(\.\w+)+(?=:|$)")
_MANY_ATTRIBUTES = 15


class _File(NamedTuple):
    """The facts of a file of the product. Its syntax tree would be a thousand times as large."""

    name: str
    names: frozenset[str]
    """The modules of the appliance that it names: in imports, also late ones, and in strings."""
    members: tuple[str, ...]
    """The names that the core looks for in the files of features."""
    late: tuple[int, ...]
    names_a_feature: bool
    reads_records: bool
    wide: tuple[str, ...]
    any: tuple[int, ...]


def _paths() -> Iterator[Path]:
    return python_files(("appliance", "roswire", "rosmop", "fleet/rosrv_fleet"), without="rosmop/tests")


@cache
def _product() -> tuple[_File, ...]:
    paths = _paths()
    code = (__file__, counts.__file__)
    context = sorted(_modules()) + sorted(_aliases_of_any())
    return tuple(facts_of_files(_File, _facts, paths, code=code, context=context).values())


def _facts(path: Path) -> _File:
    tree, name = parsed(path), name_of(path)
    within = nodes(tree)
    return _File(
        name,
        frozenset(_module_names(within)),
        tuple(_members(within)),
        tuple(sorted(_late_imports(tree))),
        _is_core(name) and _names_a_feature(within, certificates=name.startswith(_CERTIFICATES)),
        re.search(r"\bFROM record\b", path.read_text(encoding="utf-8")) is not None,
        tuple(_wide_classes(within)),
        tuple(_lines_with_any(_module(path), tree, _aliases_of_any())),
    )


@cache
def _modules() -> Mapping[str, Path]:
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in (ROOT / "appliance").rglob("*.py")
    }


def _module_names(within: Sequence[ast.AST]) -> Iterator[str]:
    modules = _modules()
    for node in within:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                member = f"{node.module}.{alias.name}"
                yield from ({member if member in modules else node.module} & modules.keys())
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            match = _MODULE_NAME.match(node.value)
            yield from ({match[0]} if match else set()) & modules.keys()


@cache
def _reexported(module: str) -> frozenset[str]:
    """Return the core modules whose names a module passes on: those of `__all__`, or `import x as x`."""
    tree = parsed(_modules()[module])
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
    for file in _product():
        if file.name.startswith("appliance/features/"):
            for module in file.names:
                imported |= {module} | _reexported(module)
    return sorted(module for module in imported if not module.startswith("appliance.features."))


_MACHINERY = (
    "api", "audit.log.housekeeping", "audit.log.log", "audit.log.log_writer", "backup", "channel.channel",
    "channel.child_process", "channel.link", "cli.connection", "compiler", "control", "forwarding", "hosts", "master",
    "relay", "rpc", "specifications", "store", "supervisor", "telemetry",
)  # fmt: skip
"""The folders and modules with state, processes or connections of the core."""


def _is_machinery(module: str) -> bool:
    below = module.removeprefix("appliance.")
    return any(below == folder or below.startswith(f"{folder}.") for folder in _MACHINERY)


def machinery_that_features_import() -> list[str]:
    return [module for module in modules_that_features_import() if _is_machinery(module)]


def libraries_that_features_import() -> list[str]:
    """Return formats, texts, codecs and other code without state of the core, which any program may import."""
    return [module for module in modules_that_features_import() if not _is_machinery(module)]


def names_of_a_feature() -> list[str]:
    """Return the fields of a feature and of its part, and the names that the core looks for in its files."""
    names = [
        f"{node.name}.{field.target.id}"
        for file in ("features/feature.py", "control/core.py")
        for node in parsed(ROOT / "appliance" / file).body
        if isinstance(node, ast.ClassDef) and node.name in {"Tool", "Feature", "ControlPart"}
        for field in node.body
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
    ]
    return names + sorted({member for file in _product() for member in file.members})


def _members(within: Sequence[ast.AST]) -> Iterator[str]:
    for node in within:
        match node:
            case ast.Call(ast.Name("members"), [ast.Constant(str(file)), ast.Constant(str(member))]):
                yield f"{file}.py: {member}"


def phases_of_a_feature() -> list[str]:
    """Return the functions of a feature that control calls."""
    calls = [name for name in names_of_a_feature() if name.startswith(("control_part.py", "gate.py"))]
    return [name for name in calls if name != "gate.py: GATE"]  # the one exception, of pairs


def late_imports() -> list[str]:
    """Return the imports inside of functions."""
    return [f"{file.name}:{line}" for file in _product() for line in file.late]


def _late_imports(tree: ast.Module) -> set[int]:
    return {
        node.lineno
        for function in functions(tree)
        for node in statements(function)
        if isinstance(node, ast.Import | ast.ImportFrom)
    }


def core_files_that_name_features() -> list[str]:
    """Return the core files with an identifier that names one of seven features."""
    return [file.name for file in _product() if file.names_a_feature]


def _is_core(name: str) -> bool:
    return name.startswith("appliance/") and not name.startswith("appliance/features/")


def _identifiers(within: Sequence[ast.AST]) -> Iterator[str]:
    for node in within:
        match node:
            case (
                ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.keyword(arg=str(name))
            ):
                yield name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.alias(name=name):
                yield from name.split(".")


def _names_a_feature(within: Sequence[ast.AST], *, certificates: bool) -> bool:
    return any(_is_a_feature(name, certificates=certificates) for name in _identifiers(within))


@cache
def _is_a_feature(identifier: str, *, certificates: bool) -> bool:
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", identifier).lower()
    parts = {words, *words.split("_")} - ({"authority"} if certificates else set())
    return any(map(_FEATURE_WORDS.fullmatch, parts))


def walkers_of_the_audit_log() -> list[str]:
    """Return the modules, besides those that write the log, whose SQL reads its records."""
    return [
        file.name
        for file in _product()
        if file.reads_records and not file.name.startswith("appliance/audit/log/")
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
    return [f"{file.name}: {row}" for file in _product() for row in file.wide]


def _wide_classes(within: Sequence[ast.AST]) -> Iterator[str]:
    for node in within:
        if isinstance(node, ast.ClassDef) and (number := len(_attributes(node))) >= _MANY_ATTRIBUTES:
            yield f"{node.name} {number}"


def _attributes(node: ast.ClassDef) -> set[str]:
    """Return the attributes that a class's methods set: its state, without the fields of plain data."""
    return {
        inner.attr
        for inner in nodes(node)
        if isinstance(inner, ast.Attribute)
        and isinstance(inner.ctx, ast.Store)
        and isinstance(inner.value, ast.Name)
        and inner.value.id == "self"
    }


def _module(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[parts[0] == "fleet" :]).removesuffix(".__init__")


@cache
def _aliases_of_any() -> frozenset[str]:
    """Return the names of the product, with their modules, that stand for `Any`, also through each other."""
    texts = {path: path.read_text(encoding="utf-8") for path in _paths()}
    aliases: set[str] = set()
    while True:
        words = "|".join({"Any", *(alias.rpartition(".")[2] for alias in aliases)})
        defines = re.compile(rf"^\w+(: \w+)? = (?=\S)[^(\n]*\b({words})\b", re.MULTILINE)
        paths = [path for path, text in texts.items() if defines.search(text)]
        new = {name for path in paths for name in _new_aliases(_module(path), parsed(path), aliases)}
        if new <= aliases:
            return frozenset(aliases)
        aliases |= new


def _new_aliases(module: str, tree: ast.Module, aliases: Collection[str]) -> Iterator[str]:
    meanings = _meanings(module, tree, aliases)
    for node in tree.body:
        match node:
            case ast.Assign([ast.Name(name)], value) | ast.AnnAssign(ast.Name(name), _, ast.expr() as value):
                if any(
                    isinstance(part, ast.Name) and part.id in meanings for part in _members_of_union(value)
                ):
                    yield f"{module}.{name}"


def _members_of_union(kind: ast.expr) -> Iterator[ast.expr]:
    match kind:
        case ast.BinOp(left, ast.BitOr(), right):
            yield from (*_members_of_union(left), *_members_of_union(right))
        case ast.Subscript(ast.Name("Optional" | "Union" | "Annotated"), ast.Tuple(members)):
            yield from (part for member in members for part in _members_of_union(member))
        case ast.Subscript(ast.Name("Optional" | "Union" | "Annotated"), member):
            yield from _members_of_union(member)
        case _:
            yield kind


def _meanings(module: str, tree: ast.Module, aliases: Collection[str]) -> set[str]:
    """Return the names that stand for `Any` in a module, as it imports or defines them."""
    imported = {
        alias.asname or alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if f"{node.module}.{alias.name}" in {"typing.Any", *aliases}
    }
    return imported | {alias.rpartition(".")[2] for alias in aliases if alias.rpartition(".")[0] == module}


def _lines_with_any(module: str, tree: ast.Module, aliases: Collection[str]) -> Iterator[int]:
    meanings, within = _meanings(module, tree, aliases), nodes(tree)
    modules = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in within
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    for node in within:
        match node:
            case ast.Name(name, ast.Load()) if name in meanings:
                yield node.lineno
            case ast.Attribute(ast.Name(space), name) if f"{modules.get(space)}.{name}" in aliases:
                yield node.lineno


def uses_of_any() -> list[str]:
    """Return the uses of `Any`, and of each name that stands for it."""
    return [f"{file.name}:{line}" for file in _product() for line in file.any]


COUNTS = (
    Count("machinery", "core modules with state that features import", 91, 74, machinery_that_features_import),
    Count("libraries", "other core modules that features import", 138, 138, libraries_that_features_import),
    Count("names", "names of a feature, of its files and of its part", 16, 10, names_of_a_feature),
    Count("phases", "phases of a feature in control", 1, 1, phases_of_a_feature),
    Count("late", "late imports in product code", 19, 10, late_imports),
    Count("spoken", f"core files with an identifier of {_NAMED}", 9, 9, core_files_that_name_features),
    Count("walkers", "modules with SQL of their own that reads the audit log", 3, 3, walkers_of_the_audit_log),
    Count("registration", "files of one registerPublisher", 48, 48, files_of_a_registration),
    Count("wide", "classes with 15 attributes or more", 32, 30, classes_with_many_attributes),
    Count("any", "uses of `Any` in product code", 494, 494, uses_of_any),
)  # fmt: skip


if __name__ == "__main__":
    sys.exit(main("interfaces", COUNTS, sys.argv[1:]))
