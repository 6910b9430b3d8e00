"""Run one side of the replication in a process, which tests kill.

    python -m tests.support.features.standby.replication_process SIDE DIRECTORY PORT DESCRIPTOR

The active side makes random changes, and prints the number of each mark that is acknowledged. After a line on
standard input it stops, and prints `equal` when the standby has all changes. Its parent owns the listening socket
(DESCRIPTOR), so the port stays the same.
"""

import asyncio
import random
import socket
import sys
from pathlib import Path

import structlog

from tests.support.features.standby.replication import ActiveSide, StandbySide, certificates, change_randomly


async def main() -> None:
    structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
    side, directory, port = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    server, client = certificates(directory)
    if side == "standby":
        StandbySide(directory / "standby.db", client, lambda: port)
        await asyncio.Event().wait()
    active = ActiveSide(
        directory / "active.db", server, room=50_000, listening=socket.socket(fileno=int(sys.argv[4]))
    )
    stopped = asyncio.Event()
    asyncio.get_running_loop().add_reader(0, stopped.set)
    chosen = random.Random(active.database.history)  # noqa: S311  draws examples
    (last,) = active.database.query("SELECT coalesce(max(number), 0) FROM mark")
    mark: int = last[0]
    while not stopped.is_set():
        for _ in range(chosen.randrange(1, 10)):
            change_randomly(active.database, chosen)
        mark += 1
        active.database.put("mark", mark)
        await active.sender.until_acknowledged(active.database.number)
        _report(mark)
    await active.sender.until_acknowledged(active.database.number)
    await active.database.until_settled()
    _report("equal")


def _report(line: object) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


asyncio.run(main())
