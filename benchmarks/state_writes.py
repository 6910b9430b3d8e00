"""Time saved by the log in front of the database: python -m benchmarks.state_writes [--rate 500] [--seconds 10]

Nodes register at a rate, and each registration must survive the death of control before it is answered. Every second,
another thread saves the tree of parameters. The table shows how long one registration blocks the answering thread, in
microseconds:

- `ahead`: the program's way, a line in `state.ahead` and a statement in the queue of the writer's thread.
- `commit`: the answering thread commits the statement to SQLite's own log (WAL, `synchronous=NORMAL`). It waits while
  the other thread writes the tree, and whenever it has to move SQLite's log into the database.
"""

import argparse
import sqlite3
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

from appliance.store.state_file import RegistrationRow, StateStore

Keep = Callable[[RegistrationRow], None]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--rate", type=int, default=500, help="registrations a second")
    arguments.add_argument("--seconds", type=float, default=10)
    given = arguments.parse_args()
    table = Table("tree of parameters", "way", "median", "99 %", "longest", title="µs of one registration")
    for kib in (0, 100, 1024, 16_384):
        for way in (ahead, commit):
            with tempfile.TemporaryDirectory(dir=".") as folder:
                held_up = way(Path(folder), b"p" * (kib << 10), given.rate, given.seconds)
            cuts = statistics.quantiles(held_up, n=100)
            shown = (f"{1e6 * one:,.0f}" for one in (cuts[49], cuts[98], max(held_up)))
            table.add_row(f"{kib} KiB" if kib else "none", way.__name__, *shown)
    Console().print(table)


def ahead(folder: Path, tree: bytes, rate: int, seconds: float) -> list[float]:
    store = StateStore(folder, failed=print)
    try:
        return _registering(
            store.save_registration, lambda: store.save_parameters({"p": tree}), tree, rate, seconds
        )
    finally:
        store.close()


def commit(folder: Path, tree: bytes, rate: int, seconds: float) -> list[float]:
    StateStore(folder, failed=print).close()
    registrations, parameters = _opened(folder), _opened(folder)

    def keep(row: RegistrationRow) -> None:
        registrations.execute("INSERT OR REPLACE INTO registration VALUES (?, ?, ?, ?, ?)", row)

    def keep_tree() -> None:
        parameters.execute("INSERT OR REPLACE INTO parameters VALUES (1, ?)", (tree,))

    try:
        return _registering(keep, keep_tree, tree, rate, seconds)
    finally:
        registrations.close()
        parameters.close()


def _opened(folder: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(
        folder / "state.db", isolation_level=None, timeout=60, check_same_thread=False
    )
    connection.execute("PRAGMA synchronous=NORMAL")
    return connection


def _registering(
    keep: Keep, keep_tree: Callable[[], None], tree: bytes, rate: int, seconds: float
) -> list[float]:
    over = threading.Event()

    def keep_trees() -> None:
        while not over.wait(1.0):
            keep_tree()

    others = threading.Thread(target=keep_trees if tree else lambda: None)
    others.start()
    held_up = []
    for number in range(int(rate * seconds)):
        row = RegistrationRow(f"node{number % 100}", "topic", f"/robot/{number}", "std_msgs/String", number)
        began = time.perf_counter()
        keep(row)
        held_up.append(time.perf_counter() - began)
        over.wait(1 / rate)
    over.set()
    others.join()
    return held_up


if __name__ == "__main__":
    main()
