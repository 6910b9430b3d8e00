"""Print tables."""

import sys

from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from rosmop.tool.terminal import printable

_WIDE = 200  # columns, if the output is not a terminal


def table_of(*heads: str | Column) -> Table:
    return Table(*heads, box=None, padding=(0, 2, 0, 0), header_style="dim")


def add_row(table: Table, *cells: str) -> None:
    table.add_row(*(Text(printable(cell)) for cell in cells))


def say_table(table: Table) -> None:
    Console(highlight=False, width=None if sys.stdout.isatty() else _WIDE).print(table)
