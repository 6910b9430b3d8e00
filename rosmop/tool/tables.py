"""How verbs show tables."""

import sys

from rich.console import Console
from rich.table import Column, Table

_WIDE = 200  # columns, where nobody looks at them through a window


def table_of(*heads: str | Column) -> Table:
    """An empty table with these heads."""
    return Table(*heads, box=None, padding=(0, 2, 0, 0), header_style="dim")


def say_table(table: Table) -> None:
    """Write a table to standard output."""
    Console(highlight=False, width=None if sys.stdout.isatty() else _WIDE).print(table)
