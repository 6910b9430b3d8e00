"""Nothing is found by the name of an attribute, a class or a parameter: a misspelt name would fail late, or never."""

import ast
from collections.abc import Iterator

from tests.support.sources import ROOT, product_files

BY_NAME = {"getattr", "setattr", "hasattr", "delattr", "vars", "globals", "locals"}
FINDERS = {"import_module", "resolve_name", "attrgetter", "methodcaller"}
NAMES = {
    "__annotations__", "__dataclass_fields__", "__dict__", "__getattribute__", "__name__", "__qualname__", "__slots__",
    "__struct_fields__", "__subclasses__",
}  # fmt: skip

FIELDS = "the same for all fields of a node or struct"
IMPORTED = "imported only where it runs; a test resolves every row"
LIBRARY = "how the library or Python itself offers it"
TEXT = "a word in a text for people"
ALLOWED = {
    "appliance/api/moments.py _units": "msgspec names the schemas of structs by their classes",
    "appliance/api/operation_routes.py _add": LIBRARY,
    "appliance/api/routing.py add_api_route": LIBRARY,
    "appliance/api/routing.py components": "the schemas in the contract have the names of their structs",
    "appliance/api/routing.py tagged": "monitors have a tag, other answers with an ETag a revision",
    "appliance/audit/query.py conditions": "the fields of a filter have the names of the log's columns",
    "appliance/audit/record_format.py as_object": FIELDS,
    "appliance/audit/search.py _neighbours": "the fields of a record have the names of the log's columns",
    "appliance/backup/create.py _is_full": LIBRARY,
    "appliance/cli/connection/target.py speaking": LIBRARY,
    "appliance/cli/demo.py demo": "the demonstration is beside the package, and imports it",
    "appliance/cli/lazy.py loaded": IMPORTED,
    "appliance/cli/selftest/probe_nodes.py call": LIBRARY,
    "appliance/configuration/config_sources.py _with_absolute_paths": FIELDS,
    "appliance/control/spare_memory.py return_spare_memory": LIBRARY,
    "appliance/evidence/bundle_verifier.py ": LIBRARY,
    "appliance/evidence/bundle_verifier.py regular": LIBRARY,
    "appliance/forwarding/log_forwarder.py step": TEXT,
    "appliance/forwarding/segment_pusher.py _failed": TEXT,
    "appliance/master/calls/call.py _type_name": TEXT,
    "appliance/relay/grant_table.py _fact": "a statement and its withdrawal have the same key",
    "appliance/supervisor/child_entry.py _call": IMPORTED,
    "rosmop/batch/ray_cluster.py _reason": TEXT,
    "rosmop/check/reachable_types.py _plain": FIELDS,
    "rosmop/fast/serialization.py _made": TEXT,
    "rosmop/fast/serialization.py _plain": TEXT,
    "rosmop/fast/wasm_instance.py load": LIBRARY,
    "rosmop/prove/terms.py choice": FIELDS,
    "rosmop/run/outcomes.py __repr__": TEXT,
    "rosmop/text/tree.py fields_of": FIELDS,
    "rosmop/recordings/recording.py _text_of": TEXT,
}
"""The functions that may look up names, with the reason."""


def test_only_the_listed_functions_look_up_names() -> None:
    """A new place needs a reason in the list, and a place that is gone leaves it."""
    found = {
        f"{path.relative_to(ROOT)} {function}"
        for path in product_files()
        for function in looking_up(ast.parse(path.read_text(encoding="utf-8")))
    }
    assert found - ALLOWED.keys() == set()
    assert ALLOWED.keys() - found == set()


def test_the_rule_finds_what_it_forbids() -> None:
    """Covers functions, methods and attributes; the name of a class in a message is not a lookup."""
    for text in (
        "getattr(a, name)", "importlib.import_module(name)", "operator.attrgetter('x')", "table[kind.__name__]",
        "a.__dict__[name] = 1", "[x for x in node.__struct_fields__]", "vars(a)", "f(type(a).__name__)",
    ):  # fmt: skip
        assert list(looking_up(ast.parse(f"def f():\n    {text}"))) == ["f"], text
    for text in ("f'{type(error).__name__}: {error}'", "log(message=type(a).__name__)", "print(__name__)"):
        assert list(looking_up(ast.parse(f"def f():\n    {text}"))) == [], text


def looking_up(node: ast.AST, function: str = "") -> Iterator[str]:
    """Yield the innermost function of each lookup of a name; empty outside functions."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        function = node.name
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in BY_NAME | FINDERS:
        yield function
    if isinstance(node, ast.Attribute) and node.attr in NAMES | FINDERS:
        yield function
    for child in ast.iter_child_nodes(node):
        in_message = isinstance(child, ast.Attribute) and child.attr in ("__name__", "__qualname__")
        if not (in_message and isinstance(node, ast.FormattedValue | ast.keyword)):
            yield from looking_up(child, function)
