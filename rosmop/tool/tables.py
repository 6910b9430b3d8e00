"""Print tables. A terminal that is too narrow gets the cells of each row below one another, so nothing is cut."""

import sys

from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.table import Column, Table
from rich.text import Text

from rosmop.tool.terminal import printable

_UNBOUNDED = 10_000
_WIDE = 200  # columns, if the output is not a terminal


def table_of(*heads: str | Column) -> Table:
    table = Table(*heads, box=None, padding=(0, 2, 0, 0), header_style="dim")
    for column in table.columns:
        column.overflow = "fold"
    return table


def add_row(table: Table, *cells: str) -> None:
    table.add_row(*(Text(printable(cell)) for cell in cells))


def say_table(table: Table) -> None:
    console = Console(highlight=False, width=None if sys.stdout.isatty() else _WIDE)
    if Measurement.get(console, console.options.update(width=_UNBOUNDED), table).minimum <= console.width:
        console.print(table)
        return
    heads = [_plain(column.header) for column in table.columns]
    for first, *rest in zip(*(column.cells for column in table.columns), strict=True):
        console.print(first, soft_wrap=True)
        for head, cell in zip(heads[1:], rest, strict=True):
            if _plain(cell):
                console.print(Text(f"    {head}: " if head else "    ") + Text(_plain(cell)), soft_wrap=True)


def _plain(cell: RenderableType) -> str:
    return cell.plain if isinstance(cell, Text) else Text.from_markup(str(cell)).plain
