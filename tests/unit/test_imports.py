from graphlib import TopologicalSorter

import grimp
import pytest

_MOST_IMPORTS = 25
_LIST = "appliance.control.core"  # it names each part of control that features use


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    graph = grimp.build_graph("appliance", "roswire", "rosmop", "rosrv_fleet", cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def test_no_module_needs_one_that_needs_it(imports: dict[str, set[str]]) -> None:
    assert "rosmop.run.engine" in imports["appliance.relay.monitors.observer"], "a type-only import is seen"
    # A cycle raises a CycleError that names its modules.
    assert len(list(TopologicalSorter(imports).static_order())) == len(imports)


PUBLIC = {
    "check.sources": "compiling texts",
    "fast.build": "certifying a set, and making the parts that relays run",
    "fast.load": "loading such a part",
    "form.findings": "errors of a text, and their positions",
    "run.engine": "`MonitorSet`",
    "run.fast_path": "lanes of the fast path",
    "logics.picture": "drawing the automata of properties",
    "run.outcomes": "what came of a message, and why",
    "run.why_lines": "why, as text",
    "types.given_lists": "values of lists that operators give",
    "types.roles": "the message types of a topic's role",
}
"""The modules of the language that the appliance imports, besides those of the command (`rosmop.tool`)."""


def test_the_appliance_imports_only_public_modules_of_the_language(imports: dict[str, set[str]]) -> None:
    found = {
        (module, imported.removeprefix("rosmop."))
        for module, all_imported in imports.items()
        if module.startswith("appliance.")
        for imported in all_imported
        if imported.startswith("rosmop.")
    }
    assert {imported for _, imported in found if not imported.startswith("tool")} == set(PUBLIC)
    assert all(
        module.startswith(("appliance.cli.", "appliance.features."))
        for module, imported in found
        if imported.startswith("tool")
    )


def test_no_module_imports_too_many(imports: dict[str, set[str]]) -> None:
    wide = {
        module
        for module, imported in imports.items()
        if not module.startswith("rosmop.tests") and module != _LIST and len(imported) > _MOST_IMPORTS
    }
    assert wide == set()
