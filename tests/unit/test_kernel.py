import grimp
import pytest

from tests.support.rows import require_rows
from tests.support.sources import KERNEL_FILE, OUTSIDE, ROOT, kernel_modules, kernel_parts


def test_each_listed_module_exists() -> None:
    assert [module for module in kernel_modules() if not (ROOT / "appliance" / module).is_file()] == []


@pytest.mark.complete
def test_the_kernel_imports_only_the_modules_on_the_list() -> None:
    graph = grimp.build_graph("appliance", cache_dir=None)
    kernel = {
        "appliance." + path.removesuffix(".py").replace("/", ".")
        for path in kernel_modules()
        if path.endswith(".py")
    }
    imported = {
        found.removeprefix("appliance.")
        for module in kernel
        for found in graph.find_modules_directly_imported_by(module)
        if found not in kernel
    }
    where = f"[{OUTSIDE}] of {KERNEL_FILE.name}, or to a part of it if it can let a call or a message pass undecided"
    require_rows(imported, kernel_parts()[OUTSIDE], where)
