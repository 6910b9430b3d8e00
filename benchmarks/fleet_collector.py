"""Measure the collector: searches over many rows, while simulated appliances push and processes are killed.

    python -m benchmarks.fleet_collector --rows 10000000 --robots 20 --seconds 120 --kills 4

It fills the index of a private PostgreSQL 15 by COPY, then runs robots with the appliance's own log, signatures and
client at `--rate` records per second together, and searches. In the middle it kills the collector and PostgreSQL in
turn. At the end it proves by chain that no record is missing. It prints latencies, rates and the lag of the index.
"""

import argparse
import itertools
import json
import random
import re
import resource
import shutil
import statistics
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import psycopg
from rosrv_fleet.database import MIGRATIONS

from tests.system.fleet.fleet_site import FleetRobot, FleetSite, running
from tests.system.fleet.postgres import postgres

_DAYS = 20
_SIMULATED = 1000
_BLOCK = 5000
_INDEX = re.compile(r"CREATE INDEX (record_\w+) ON record .*?;", re.DOTALL)


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=200_000)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--rate", type=float, default=58.0, help="records per second of all robots")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--kills", type=int, default=2)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="rosrv-bench-"))
    try:
        with postgres() as cluster:
            cluster.stop()
            cluster.start(shared_buffers="512MB", maintenance_work_mem="1GB", max_wal_size="4GB")
            site = FleetSite(folder / "site", cluster.create("bench"))
            _fill(site.database, given.rows)
            cluster.stop()
            cluster.start(shared_buffers="512MB", fsync="on")
            with running(site):
                _measure(site, cluster, given)
    finally:
        shutil.rmtree(folder)


# --- many rows -------------------------------------------------------------------------------------------------------


def _fill(database: str, rows: int) -> None:
    indexes = {
        found[1]: found[0]
        for found in _INDEX.finditer((MIGRATIONS / "0001_segments_and_records.sql").read_text())
    }
    begun = time.monotonic()
    with psycopg.connect(database, autocommit=True) as connection:
        for name in indexes:
            connection.execute(f"DROP INDEX {name}".encode())
        today = datetime.now(UTC).date()
        for back in range(_DAYS):
            day = today - timedelta(back + 1)
            name = f"record_{day:%Y%m%d}"
            connection.execute(
                f"CREATE TABLE {name} PARTITION OF record FOR VALUES"
                f" FROM ('{day}') TO ('{day + timedelta(1)}')".encode()
            )
            with connection.cursor().copy(f"COPY {name} FROM STDIN".encode()) as copy:
                for block in _blocks(day.isoformat(), rows // _DAYS, back):
                    copy.write(block)
            noon = int(datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()) * 10**9
            connection.execute(
                "INSERT INTO segment VALUES ('sim', 'sim', %s, 'x', 1, 1, %s, %s, %s, %s)",
                (back, noon, noon + 86_399 * 10**9, noon, day),
            )
        print(f"{rows} rows by COPY: {time.monotonic() - begun:.0f} s", flush=True)
        for name, statement in indexes.items():
            at = time.monotonic()
            connection.execute(statement.encode())
            print(f"  {name}: {time.monotonic() - at:.0f} s", flush=True)
        connection.execute("VACUUM ANALYZE record")
        row = connection.execute("SELECT pg_size_pretty(pg_database_size(current_database()))").fetchone()
        print(f"index of {rows} rows: {row and row[0]}, {time.monotonic() - begun:.0f} s", flush=True)


def _blocks(day: str, rows: int, seed: int) -> Iterator[bytes]:
    chance = random.Random(seed)
    begin = int(datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp() * 1e9)
    step = 86_400 * 10**9 // max(rows, 1)
    for start in range(0, rows, _BLOCK):
        yield "".join(
            _row(day, begin, step, number, chance) for number in range(start, min(rows, start + _BLOCK))
        ).encode()


def _row(day: str, begin: int, step: int, number: int, chance: random.Random) -> str:
    robot, host, topic = chance.randrange(_SIMULATED), chance.randrange(200), chance.randrange(300)
    moment = begin + number * step
    denied = chance.random() < 0.02
    decision, severity = (
        ("deny", "warning" if chance.random() < 0.1 else "notice") if denied else ("allow", "info")
    )
    reason = f"no rule lets {host} publish" if denied else f"[Publishers] /cmd_{topic} lets it"
    detail = (
        f'{{"call":"registerPublisher","node":"/node{host}","type":"geometry_msgs/Twist","serial":{number}}}'
    )
    fields = (
        day, f"sim{robot:04}", "sim", number, f"{moment:020x}", moment, 1, "decision", severity, decision,
        f"10.0.{host // 250}.{host % 250}", f"/node{host}", "publish", f"/cmd_{topic}", "Publishers", "/cmd_*",
        "robot.ini", 12, 3, reason, 40, detail, "\\N",
    )  # fmt: skip
    return "\t".join(map(str, fields)) + "\n"


# --- robots and searches ---------------------------------------------------------------------------------------------


def _searches() -> dict[str, Callable[[random.Random], dict[str, str]]]:
    return {
        "newest 100": lambda _chance: {},
        "denied, a day": lambda _chance: {"deny": "true", "since": "1d"},
        "denied, any time": lambda _chance: {"deny": "true"},
        "one host": lambda chance: {"host": f"10.0.0.{chance.randrange(200)}"},
        "one robot": lambda chance: {"robot": f"sim{chance.randrange(_SIMULATED):04}"},
        "a topic's glob, a week": lambda chance: {"topic": f"/cmd_{chance.randrange(30)}*", "since": "1w"},
        "a caller's glob": lambda chance: {"caller": f"/node{chance.randrange(20)}?"},
        "rare text": lambda chance: {"text": f'"serial":{chance.randrange(100_000, 400_000)}'},
        "frequent text": lambda _chance: {"text": "registerPublisher"},
        "text of no record": lambda chance: {"text": f"nothing like {chance.random()}"},
        "warnings": lambda _chance: {"severity": "warning"},
        "host and denied": lambda chance: {"host": f"10.0.0.{chance.randrange(200)}", "deny": "true"},
    }


def _measure(site: FleetSite, cluster: Any, given: argparse.Namespace) -> None:
    robots = [FleetRobot(site, f"robot{number:04}", every=50) for number in range(given.robots)]
    ended, chance, spent = threading.Event(), random.Random(1), defaultdict[str, list[float]](list)
    begun = time.monotonic()
    with ThreadPoolExecutor(len(robots) + 2) as pool:
        working = [pool.submit(_robot, robot, given.rate / len(robots), ended) for robot in robots]
        killing = pool.submit(_kill, site, cluster, given.kills, given.seconds, ended)
        failed = _search(site, chance, spent, begun + given.seconds)
        ended.set()
        lags = [lag for work in working for lag in work.result()]
        killing.result()
    elapsed = time.monotonic() - begun
    at = time.monotonic()
    site.indexed()
    print(f"index complete {time.monotonic() - at:.1f} s after the last push")
    proofs = [json.loads(line) for line in site.run("verify", "--json").stdout.splitlines()]
    records = sum(proof["records"] for proof in proofs)
    missing = sum(proof["missing"] for proof in proofs)
    rate = records / elapsed
    print(
        f"robots: {len(robots)}, {records} records in {elapsed:.0f} s = {rate:.1f} records/s; missing: {missing}"
    )
    print(f"kills: {given.kills}; searches that failed while a process was down: {failed}")
    lags.sort()
    print(
        f"from record to receipt: median {statistics.median(lags):.1f} s, p95 {_quantile(lags, 0.95):.1f} s"
    )
    everything = sorted(itertools.chain.from_iterable(spent.values()))
    for name, times in [*spent.items(), ("all searches", everything)]:
        times.sort()
        p50, p95, most = (1e3 * one for one in (_quantile(times, 0.5), _quantile(times, 0.95), times[-1]))
        print(f"  {name:24} n={len(times):4} p50={p50:7.1f} ms p95={p95:7.1f} ms max={most:7.1f} ms")
    print(f"this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")
    for robot in robots:
        robot.close()


def _quantile(times: list[float], part: float) -> float:
    return times[min(len(times) - 1, int(part * len(times)))]


def _robot(robot: FleetRobot, rate: float, ended: threading.Event) -> list[float]:
    """Record at a rate and push; return the age of the oldest record at each push."""
    pusher, lags = robot.pusher(), []
    due = pushed = time.monotonic()
    while not ended.wait(max(0.0, due - time.monotonic())):
        robot.record(max(1, round(rate * 5)))
        due += max(1, round(rate * 5)) / rate
        while not ended.is_set():
            before, pause = pusher.progress.sent, pusher.step()
            if pusher.progress.sent > before:
                lags.append(time.monotonic() - pushed)
            if pause and not pusher.progress.trouble:
                break
            ended.wait(pause)
        pushed = time.monotonic()
    sealed = robot.sealed()
    while pusher.progress.sequence < sealed:
        threading.Event().wait(pusher.step())
    pusher.close()
    return lags or [0.0]


def _kill(site: FleetSite, cluster: Any, kills: int, seconds: float, ended: threading.Event) -> None:
    for number in range(kills):
        if ended.wait(seconds / (kills + 1)):
            return
        if number % 2 == 0:
            site.kill()
            site.start()
        else:
            cluster.kill()
            cluster.start(shared_buffers="512MB", fsync="on")


def _search(site: FleetSite, chance: random.Random, spent: dict[str, list[float]], until: float) -> int:
    failed, kinds = 0, _searches()
    client = site.client()
    headers = {"Authorization": f"Bearer {site.token}"}
    while time.monotonic() < until:
        name = chance.choice(list(kinds))
        begun = time.monotonic()
        try:
            answer = client.get("/v1/search", params=kinds[name](chance), headers=headers)
        except httpx.TransportError:
            failed += 1
            threading.Event().wait(0.2)
            continue
        if answer.status_code == 200:
            spent[name].append(time.monotonic() - begun)
        elif answer.status_code == 503:
            failed += 1
        else:
            raise AssertionError(answer.text)
        threading.Event().wait(0.05)
    client.close()
    return failed


if __name__ == "__main__":
    main()
