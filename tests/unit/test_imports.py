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


def test_no_module_imports_too_many(imports: dict[str, set[str]]) -> None:
    wide = [
        f"{module} imports {len(imported)} modules, more than {_MOST_IMPORTS}: give a part of its work to another one"
        for module, imported in imports.items()
        if not module.startswith("rosmop.tests") and module != _LIST and len(imported) > _MOST_IMPORTS
    ]
    assert not wide, "\n".join(wide)
