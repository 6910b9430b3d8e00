"""Shows how far long work is: a bar on a terminal's standard error, nothing elsewhere."""

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
)


@contextmanager
def progress(
    what: str, total: Callable[[], int], *, shares_screen: bool = False
) -> Iterator[Callable[[int], None]]:
    """Gives the function that is told how much of `total()` is done.

    `shares_screen`: the work itself writes on standard output; there is no bar where that is the terminal, too.
    """
    console = Console(stderr=True)
    if not console.is_terminal or (shares_screen and sys.stdout.isatty()):
        yield lambda _done: None
        return
    columns = (SpinnerColumn(), TextColumn(what), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total() or None)
        yield lambda done: bar.update(task, completed=done)
