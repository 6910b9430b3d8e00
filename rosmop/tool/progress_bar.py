"""Show progress on standard error: a bar on a terminal, lines if the user wants them, nothing otherwise."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


@contextmanager
def progress(
    what: str, total: Callable[[], int], *, shares_screen: bool = False, always: bool = False
) -> Iterator[Callable[[int], None]]:
    """Show progress during a block, which passes the finished part of `total()` to the function that it gets.

    If the work `shares_screen`, there is no bar when standard output is a terminal. Without a bar, `always`
    prints a line for each percent.
    """
    console = Console(stderr=True)
    is_bar = console.is_terminal and not (shares_screen and sys.stdout.isatty())
    if not is_bar and not always:
        yield lambda _done: None
        return
    columns = (
        SpinnerColumn(), TextColumn(what), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True, disable=not is_bar) as bar:
        task = bar.add_task(what, total=total() or None)
        shown = -1

        def advance(done: int) -> None:
            nonlocal shown
            bar.update(task, completed=done)
            row = bar.tasks[0]
            if not is_bar and int(row.percentage) > shown:
                shown = int(row.percentage)
                left = "" if row.time_remaining is None else f", {row.time_remaining:.0f} s left"
                sys.stderr.write(f"{what}: {shown} %{left}\n")

        yield advance
