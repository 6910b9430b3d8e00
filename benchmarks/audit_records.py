"""Measure how fast audit records are written, proven and found: python -m benchmarks.audit_records [RECORDS]

Searches are over RECORDS (by default a million) records. All files are in one directory (TMPDIR) on one disk.
"""

import asyncio
import contextlib
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from appliance.audit.log.folding import FoldSettings
from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.audit.proof.verification import verify
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.features.syslog.log_forwarder import LogForwarder
from appliance.features.syslog.receiver import StreamReceiver
from appliance.features.syslog.syslog import Formatter
from benchmarks.syslog_sink import Sink

_ROWS: list[tuple[str, str]] = []


def row(name: str, value: str) -> None:
    _ROWS.append((name, value))
    print(f"{name:<66} {value:>16}", flush=True)


def record(log: AuditLog, number: int) -> AuditRecord:
    """Return a record. One in ten thousand is special, so that selective searches find something."""
    special = number % 10_000 == 9_999
    return AuditRecord(
        id=log.ids.next(),
        time=time.time_ns(),
        event="decision",
        severity=Severity.INFO,
        decision="deny" if number % 10 == 0 else "allow",
        host="10.99.0.1" if special else f"10.0.{number % 7}.{number % 200}",
        caller_id=f"/robot/node{number % 997}",
        category=("publish", "subscribe", "command", "read")[number % 4],
        resource="/secret/joint" if special else f"/topic{number % 499}/data",
        rule=RuleReference("Publishers", "/topic*/**", "landshark.ini", 12),
        revision=3,
        reason="[Publishers] /topic*/** lets it (landshark.ini:12)",
        duration_us=40,
        detail={"call": "registerPublisher", "type": "needle/Haystack" if special else "std_msgs/String"},
    )


def open_log(directory: Path, name: str, durability: str) -> AuditLog:
    return AuditLog(
        directory / name / "audit.db",
        durability="strict" if durability == "strict" else "batched",
        fold=FoldSettings(seconds=0),
        queue_limit=10_000_000,
    )


def measure_burst(directory: Path, count: int) -> None:
    log = open_log(directory, "burst", "batched")
    records = [record(log, number) for number in range(count)]
    start = time.perf_counter()
    for one in records:
        log.record(one)
    queued = time.perf_counter() - start
    asyncio.run(log.wait_durable())
    total = time.perf_counter() - start
    row("record(): cost to the caller in a burst", f"{queued / count * 1e6:.2f} us")
    row("batched, burst: records a second to disk", f"{count / total:,.0f}")
    start = time.perf_counter()
    for _ in range(count):
        log.ids.next()
    row("ids.next()", f"{(time.perf_counter() - start) / count * 1e6:.2f} us")
    log.close()


async def _clients(log: AuditLog, clients: int, each: int) -> float:
    async def client(first: int) -> None:
        for number in range(each):
            log.record(record(log, first + number))
            await log.wait_durable()

    start = time.perf_counter()
    await asyncio.gather(*(client(number * each) for number in range(clients)))
    return clients * each / (time.perf_counter() - start)


def measure_strict(directory: Path) -> None:
    for clients in (1, 10, 100, 1000):
        log = open_log(directory, f"strict{clients}", "strict")
        rate = asyncio.run(_clients(log, clients, max(20, 10_000 // clients)))
        row(f"strict: records a second, {clients} concurrent callers", f"{rate:,.0f}")
        log.close()


async def _paced(log: AuditLog, rate: int, seconds: float) -> tuple[float, float]:
    """Record at a rate from an event loop, and return the delay of its other work (median and 99.9 %) in ms."""
    late: list[float] = []

    async def other_work() -> None:
        while True:
            before = time.perf_counter()
            await asyncio.sleep(0)
            late.append(time.perf_counter() - before)
            await asyncio.sleep(0.0005)

    work = asyncio.create_task(other_work())
    start, sent = time.perf_counter(), 0
    while (passed := time.perf_counter() - start) < seconds:
        while sent < passed * rate:
            log.record(record(log, sent))
            sent += 1
        await asyncio.sleep(0.001)
    work.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await work
    late.sort()
    return late[len(late) // 2] * 1e3, late[int(len(late) * 0.999)] * 1e3


def measure_loop(directory: Path) -> None:
    log = open_log(directory, "paced", "batched")
    median, worst = asyncio.run(_paced(log, 10_000, 5.0))
    row("10,000 records/s from an event loop: its other work waits, median", f"{median:.3f} ms")
    row("10,000 records/s from an event loop: its other work waits, 99.9 %", f"{worst:.2f} ms")
    row("10,000 records/s: behind after 5 s", f"{log.lag.records:,} records")
    log.close()


def measure_busy(directory: Path) -> None:
    """Record beside a thread that never releases the interpreter lock voluntarily."""
    log = open_log(directory, "busy", "batched")
    records = [record(log, number) for number in range(50_000)]
    stop = threading.Event()

    def spin() -> None:
        while not stop.is_set():
            sum(range(100))

    busy = threading.Thread(target=spin)
    busy.start()
    start = time.perf_counter()
    for one in records:
        log.record(one)
    asyncio.run(log.wait_durable())
    row(
        "batched next to a thread that is busy all the time: records/s",
        f"{50_000 / (time.perf_counter() - start):,.0f}",
    )
    stop.set()
    busy.join()
    log.close()


def measure_forwarding(directory: Path, count: int) -> None:
    log = open_log(directory, "forward", "batched")
    for number in range(count):
        log.record(record(log, number))
    asyncio.run(log.wait_durable())
    log.close()
    path = directory / "forward" / "audit.db"
    formatter = Formatter(facility=13, longest=8192, host_name="robot")
    with Sink() as sink:
        kept = path.with_name("position.json")
        one = LogForwarder(path, kept, StreamReceiver("127.0.0.1", sink.port), formatter, chosen="all")
        start, used = time.perf_counter(), time.process_time()
        while one.step() == 0.0:
            pass
        row("forwarded over TCP: records/s", f"{count / (time.perf_counter() - start):,.0f}")
        row(
            "forwarded: CPU of a record (with the receiver's)",
            f"{(time.process_time() - used) / count * 1e6:.0f} us",
        )
        one.close()


def timed(name: str, action: Callable[[], object]) -> None:
    best = float("inf")
    for _ in range(3):
        start = time.perf_counter()
        action()
        best = min(best, time.perf_counter() - start)
    row(name, f"{best * 1e3:.1f} ms")


def measure_search(directory: Path, count: int) -> None:
    log = open_log(directory, "search", "batched")
    path = directory / "search" / "audit.db"
    start = time.perf_counter()
    for number in range(count):
        log.record(record(log, number))
        if number % 50_000 == 0:
            asyncio.run(log.wait_durable())
    asyncio.run(log.wait_durable())
    row(f"writing {count:,} records", f"{time.perf_counter() - start:.1f} s")
    log.close()
    row("bytes on disk for each record", f"{path.stat().st_size / count:.0f}")
    now = time.time_ns()
    for name, wanted in {
        "newest 100": Filter(),
        "denied (one in ten)": Filter(decision=("deny",)),
        "host (100 of them)": Filter(host="10.99.0.1"),
        "topic glob (100 of them)": Filter(resource="/secret/*"),
        "topic glob (many)": Filter(resource="/topic1*"),
        "topic glob that nothing matches": Filter(resource="/nothing*"),
        "denied + since + topic glob": Filter(
            decision=("deny",), since=now - 3600 * 10**9, resource="/topic2*"
        ),
        "two filters that never meet": Filter(decision=("deny",), category="subscribe"),
        "rule that nothing matches": Filter(rule="Nothing*"),
        "text (100 of them)": Filter(text="needle/Hay"),
        "text (everything)": Filter(text="landshark"),
        "text that nothing matches": Filter(text="qqqqqq"),
        "text of two letters that nothing matches": Filter(text="qq"),
    }.items():
        timed(f"search {count:,}: {name}", partial(search, path, wanted))
    start = time.perf_counter()
    result = verify(path)
    row(f"verify {count:,}", f"{time.perf_counter() - start:.1f} s, ok={result.ok}")


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    print(f"{os.cpu_count()} cores, Python {sys.version.split()[0]}")
    with tempfile.TemporaryDirectory(prefix="audit-benchmark-") as name:
        directory = Path(name)
        for part in (
            "burst",
            "paced",
            "busy",
            "search",
            "forward",
            *(f"strict{n}" for n in (1, 10, 100, 1000)),
        ):
            (directory / part).mkdir()
        measure_burst(directory, 100_000)
        measure_loop(directory)
        measure_busy(directory)
        measure_strict(directory)
        measure_forwarding(directory, 20_000)
        measure_search(directory, count)


if __name__ == "__main__":
    main()
