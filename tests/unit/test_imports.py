"""What imports what."""

from graphlib import TopologicalSorter

import grimp


def test_no_module_needs_one_that_needs_it() -> None:
    """There is no circle of modules, those included that are imported for their types only."""
    graph = grimp.build_graph("appliance", "roswire", "rosmop", cache_dir=None)
    needs = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    assert "rosmop.run.engine" in needs["appliance.api.monitor_judgement"], "a type-only import is seen"
    # A circle is a CycleError that names its modules.
    assert len(list(TopologicalSorter(needs).static_order())) == len(needs)
