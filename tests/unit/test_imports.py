from graphlib import TopologicalSorter

import grimp
import pytest


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    graph = grimp.build_graph("appliance", "roswire", "rosmop", "rosrv_fleet", cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def test_no_module_needs_one_that_needs_it(imports: dict[str, set[str]]) -> None:
    assert "rosmop.run.engine" in imports["appliance.relay.monitors.observer"], "a type-only import is seen"
    # A cycle raises a CycleError that names its modules.
    assert len(list(TopologicalSorter(imports).static_order())) == len(imports)
