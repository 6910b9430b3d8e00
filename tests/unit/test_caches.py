"""Each cache states what becomes of a failure: one that keeps successes only lets its caller repeat the work."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("appliance", "roswire", "rosmop", "fleet/rosrv_fleet")
CACHES = {"cache", "lru_cache", "functools.cache", "functools.lru_cache"}
NEVER = "cannot fail"
KEPT = "a failure is a result, and kept"
SHORT = "a failure costs no more than reading its text, which is bounded"
OURS = "its argument is ours or an operator's"

FAILURES = {
    "appliance/api/front/moments.py::_units": OURS,
    "appliance/audit/log/log_writer.py::_count": NEVER,
    "appliance/audit/log/log_writer.py::_insert": NEVER,
    "appliance/audit/search/denial_summary.py::_without_numbers": NEVER,
    "appliance/audit/search/search.py::_networks_of": OURS,
    "appliance/base/varying_numbers.py::without_numbers": NEVER,
    "appliance/channel/admin.py::_decoder": OURS,
    "appliance/channel/rest_operation.py::_fields": OURS,
    "appliance/cli/verb_table.py::_text": OURS,
    "appliance/cli/standing.py::_definitions": NEVER,
    "appliance/configuration/config_sources.py::_reader": OURS,
    "appliance/configuration/inventory.py::inventory": OURS,
    "appliance/features/doors/rosbridge_frames.py::_publish_head": NEVER,
    "appliance/features/guards/released.py::versions_of": OURS,
    "appliance/features/guards/presets.py::_value_of": OURS,
    "appliance/features/guards/released.py::origin_of": OURS,
    "appliance/features/standby/witness.py::tag_of": NEVER,
    "appliance/features/views.py::pair_view": OURS,
    "appliance/network/cut.py::_libc": NEVER,
    "appliance/policy/model.py::address_of": SHORT,
    "appliance/relay/monitors/monitor_sets.py::prepare": NEVER,
    "appliance/specifications/checking.py::_standard": NEVER,
    "appliance/specifications/specification_files.py::_definitions": KEPT,
    "rosmop/check/function_library.py::functions": OURS,
    "rosmop/fast/build.py::_part": OURS,
    "rosmop/fast/build.py::_set": OURS,
    "rosmop/fast/wasm_instance.py::_engine": OURS,
    "rosmop/fast/wasm_instance.py::load": OURS,
    "rosmop/run/interpreter.py::_nobody": OURS,
    "rosmop/text/parser.py::_parser": OURS,
    "roswire/parameter_tree.py::parts_of": NEVER,
    "roswire/uris.py::parse_node_uri": SHORT,
}


def caches(path: Path) -> Iterator[str]:
    """Yield the functions with a cache: decorated ones, and names that are bound to one."""
    name, text = str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text if "cache" in text else "")):
        if isinstance(node, ast.FunctionDef) and any(map(_is_cache, node.decorator_list)):
            yield f"{name}::{node.name}"
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and _is_cache(node.value.func):
            yield from (f"{name}::{ast.unparse(target)}" for target in node.targets)


def _is_cache(expression: ast.expr) -> bool:
    called = expression.func if isinstance(expression, ast.Call) else expression
    return ast.unparse(called) in CACHES


def test_each_cache_says_what_becomes_of_a_failure() -> None:
    files = [
        file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py") if "tests" not in file.parts
    ]
    found = {one for file in files for one in caches(file)}
    assert found == FAILURES.keys()


@pytest.mark.parametrize(
    "text",
    [
        "@cache\ndef one(): ...",
        "@functools.lru_cache(8)\ndef one(): ...",
        "one = lru_cache(maxsize=1)(other)",
    ],
)
def test_each_form_of_a_cache_is_found(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.unit.test_caches.ROOT", tmp_path)
    (tmp_path / "module.py").write_text(text)
    assert [*caches(tmp_path / "module.py")] == ["module.py::one"]
