"""System tests run two at a time (`-n 2 --dist loadgroup`): what shares an engine or a browser stays together.

A folder is one group, so that its Docker engine, its images or its virtual machine are made once; each file beside
the folders is a group of its own.
"""

from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Name the group of each test; without xdist the mark says nothing to anybody."""
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker(pytest.mark.xdist_group(item.path.relative_to(HERE).parts[0]))
