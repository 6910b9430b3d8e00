"""Measure a site: 1,000 simulated appliances push logs and take bundles, operators search, and processes are killed.

    python -m benchmarks.fleet                                  # 1,000 appliances, 10,000,000 rows: 16 minutes
    python -m benchmarks.fleet --robots 50 --rows 100000 --seconds 20

The collector is the released program, with a private PostgreSQL 15. The appliances use their own log and both clients
(`benchmarks/fleet_robots.py`). All share this machine's processors, the appliances with niceness 10. The parts:

1. All appliances connect and push at the same time, as after a power failure of the site.
2. They record and push at `--rate` records a second together, while an operator searches many rows.
3. A bundle is rolled out to all of them at once, three times; then a bad one in rings, whose canaries refuse it.
4. The collector and PostgreSQL are killed in turn.
5. The chains of all logs prove that no record is missing, and each record is found once.
"""

import argparse
import json
import os
import random
import shutil
import statistics
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import httpx
import psycopg
from rosrv_fleet.bundles.repository import TIMESTAMP_KEY, BundleRepository, KeyFolder

from appliance.formats.terms import Ring
from benchmarks.fleet_robots import BAD, SimulatedLoad, SimulatedRobots, enrol
from benchmarks.fleet_rows import fill, searches
from fleet.tests.support.bundle_site import GROUP, PASSPHRASE, SITE, bundle_files, everywhere
from fleet.tests.support.fleet_site import FleetSite
from fleet.tests.support.postgres import PostgresCluster, postgres

_PAUSE = threading.Event()  # never set
_LONGEST_SECONDS = 600.0
_CANARIES = 10
_SERVER = {"shared_buffers": "512MB", "fsync": "on"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=4, help="of the simulated appliances")
    parser.add_argument("--rows", type=int, default=10_000_000, help="rows of earlier days in the index")
    parser.add_argument("--rate", type=float, default=58.0, help="records a second of all appliances")
    parser.add_argument("--seconds", type=float, default=180.0, help="seconds of parts 2 and 4, each")
    parser.add_argument("--bundles", type=int, default=3)
    parser.add_argument("--kills", type=int, default=4)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="rosrv-bench-"))
    try:
        with postgres() as cluster:
            cluster.stop()
            cluster.start(shared_buffers="512MB", maintenance_work_mem="1GB", max_wal_size="4GB")
            site = FleetSite(folder / "site", cluster.create("bench"))
            fill(site.database, given.rows)
            cluster.stop()
            cluster.start(**_SERVER)
            _Measurement(site, cluster, given).run()
    finally:
        shutil.rmtree(folder)


class _Measurement:
    def __init__(self, site: FleetSite, cluster: PostgresCluster, given: argparse.Namespace) -> None:
        self._site, self._cluster, self._given = site, cluster, given
        keys = KeyFolder(site.folder / "keys", lambda _key: PASSPHRASE)
        self._repository = BundleRepository(site.folder / "repository", keys)
        self._repository.init()
        self._repository.delegate(SITE, GROUP)
        folder = self._repository.folder
        site.write_config(bundles={"folder": str(folder), "timestamp_key": str(folder / TIMESTAMP_KEY)})
        self._operator = site.run("token", "add", "operator", "--role", "operator").stdout.strip()
        self._names = [f"robot{number:04}" for number in range(given.robots)]
        period = max(60.0, given.robots / given.rate)
        records = max(1, round(period * given.rate / given.robots))
        root = (folder / "root.json").read_bytes()
        load = SimulatedLoad(records, records * given.robots / given.rate, root)
        self._robots = SimulatedRobots(site, self._names, given.processes, load)

    def run(self) -> None:
        self._robots.start()
        enrol(self._site, self._names)
        self._site.start()
        try:
            begun = time.monotonic()
            self._all_at_once()
            searching = _Searches(self._site)
            self._timed("steady", lambda: _PAUSE.wait(self._given.seconds), searching)
            self._timed("bundles", self._bundles, searching)
            self._timed("kills", self._kills, searching)
            searching.end()
            lags = self._robots.end()
            self._prove(begun, lags)
        finally:
            self._robots.kill()
            self._site.kill()

    def _timed(self, name: str, part: Callable[[], object], searching: "_Searches") -> None:
        begun, spent, program = time.monotonic(), self._processor_seconds(), self._site.pid
        searching.take()
        part()
        times, failed = searching.take()
        elapsed, used = time.monotonic() - begun, self._processor_seconds()
        print(f"{name}: {elapsed:.0f} s; load average {os.getloadavg()[0]:.1f}", end="")
        if self._site.pid == program:
            print(*(f"; {who}: {used[who] - spent[who]:.1f} s of processor time" for who in used), end="")
        print(flush=True)
        print(f"  searches: {_quantiles(times['all'])}; {failed} failed", flush=True)
        if name == "steady":
            for kind, found in sorted(times.items()):
                print(f"    {kind:24} {_quantiles(found)}", flush=True)

    # --- parts ---

    def _all_at_once(self) -> None:
        begun = time.monotonic()
        self._robots.begin()
        self._until(lambda: self._site.stored() >= len(self._names), "every appliance has a receipt")
        print(
            f"all at once: {len(self._names)} appliances have a receipt after {time.monotonic() - begun:.1f} s"
        )
        self._until(self._all_report, "every appliance has reported")
        print(f"  and have reported their bundle after {time.monotonic() - begun:.1f} s", flush=True)
        few = len(self._names) // 100  # while segments arrive, some always wait
        self._until(lambda: self._site.health()["waiting"] <= few, "the index is nearly complete")
        print(
            f"  and 99 % are searchable after {time.monotonic() - begun:.1f} s; {self._memory()}", flush=True
        )

    def _bundles(self) -> None:
        times = []
        for number in range(self._given.bundles):
            self._publish(f"# {number}\n", Ring("all", [], 100))
            begun = time.monotonic()
            self._order(share=1)
            self._until(
                lambda: self._rings()[-1]["in_force"] == len(self._names), "it is in force everywhere"
            )
            times.append(time.monotonic() - begun)
            print(f"bundle in force on {len(self._names)} appliances after {times[-1]:.1f} s", flush=True)
        print(f"  median {statistics.median(times):.1f} s")
        self._publish(BAD, Ring("canary", self._names[:_CANARIES]), Ring("all", [], 100))
        begun = time.monotonic()
        self._order()
        self._until(lambda: self._rollout()["state"] == "stopped", "the bad bundle is stopped")
        print(f"bad bundle stopped after {time.monotonic() - begun:.1f} s: {self._rollout()['why'][:80]}")
        taken = sum(ring["in_force"] for ring in self._rings())
        print(f"  {taken} appliances took it", flush=True)

    def _kills(self) -> None:
        for number in range(self._given.kills):
            _PAUSE.wait(self._given.seconds / (self._given.kills + 1))
            if number % 2 == 0:
                self._site.kill()
                self._site.start()
            else:
                self._cluster.kill()
                self._cluster.start(**_SERVER)
        _PAUSE.wait(self._given.seconds / (self._given.kills + 1))

    def _prove(self, begun: float, lags: list[float]) -> None:
        elapsed = time.monotonic() - begun
        at = time.monotonic()
        self._site.indexed()
        print(f"the index is complete {time.monotonic() - at:.1f} s after the last push")
        proofs = [json.loads(line) for line in self._site.run("verify", "--json").stdout.splitlines()]
        records = sum(proof["records"] for proof in proofs)
        missing = sum(proof["missing"] for proof in proofs)
        with psycopg.connect(self._site.database) as connection:
            query = "SELECT count(*), count(DISTINCT (robot, sequence)) FROM record WHERE robot LIKE 'robot%'"
            row = connection.execute(query).fetchone()
        assert row is not None
        rate = records / elapsed
        print(
            f"{len(proofs)} logs: {records} records in {elapsed:.0f} s, {rate:.1f} a second; missing {missing}"
        )
        print(f"  in the index: {row[0]} rows of {row[1]} records")
        print(f"  from the seal to the receipt: {_quantiles(lags)}", flush=True)

    # --- the collector as an operator sees it ---

    def _publish(self, policy: str, *rings: Ring) -> None:
        text = bundle_files()["policy.ini"].decode() + policy
        self._bundle = str(self._repository.add(SITE, GROUP, bundle_files(text), everywhere(None, *rings)))

        def published() -> bool:
            return bool(self._bundle in self._ask("GET", "")["published"])

        self._until(published, "the bundle is published")

    def _order(self, **gates: float) -> None:
        wanted = {"healthy_seconds": 0, "silent_seconds": 600} | gates
        self._ask("POST", "", {"bundle": self._bundle, "gates": wanted})

    def _rollout(self) -> dict[str, Any]:
        return dict(self._ask("GET", f"/{SITE}/{GROUP}")["rollout"])

    def _rings(self) -> list[dict[str, Any]]:
        return list(self._rollout()["rings"])

    def _all_report(self) -> bool:
        (group,) = self._ask("GET", "")["groups"]
        return bool(group["robots_known"] == len(self._names) and not group["conditions"]["never seen"])

    def _ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> dict[str, Any]:
        with self._site.client() as client:
            answer = client.request(
                method,
                f"/v1/rollouts{path}",
                json=body,
                headers={"Authorization": f"Bearer {self._operator}"},
            )
        answer.raise_for_status()
        return dict(answer.json())

    def _until(self, there: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + _LONGEST_SECONDS
        while time.monotonic() < deadline:
            if there():
                return
            _PAUSE.wait(0.25)
        raise SystemExit(f"not within {_LONGEST_SECONDS:g} s: {what}")

    def _processor_seconds(self) -> dict[str, float]:
        return {
            "collector": _ticks(_family(self._site.pid)),
            "PostgreSQL": _ticks(_family(self._cluster.pid)),
            "appliances": _ticks(process.pid or 0 for process in self._robots.processes),
        }

    def _memory(self) -> str:
        pids = _family(self._site.pid)
        return f"collector: {sum(map(_resident_bytes, pids)) / 2**20:.0f} MiB in {len(pids)} processes"


class _Searches:
    def __init__(self, site: FleetSite) -> None:
        self._site = site
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._times = defaultdict[str, list[float]](list)
        self._failed = 0
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def take(self) -> tuple[dict[str, list[float]], int]:
        with self._lock:
            found, self._times = self._times, defaultdict(list)
            failed, self._failed = self._failed, 0
        return {**found, "all": [moment for times in found.values() for moment in times]}, failed

    def end(self) -> None:
        self._ended.set()
        self._thread.join()

    def _work(self) -> None:
        chance, kinds = random.Random(1), searches()
        headers = {"Authorization": f"Bearer {self._site.token}"}
        with self._site.client() as client:
            while not self._ended.wait(0.25):
                kind = chance.choice(list(kinds))
                begun = time.monotonic()
                try:
                    answer = client.get("/v1/search", params=kinds[kind](chance), headers=headers)
                    works = answer.status_code == 200
                except httpx.TransportError:
                    works = False
                with self._lock:
                    self._failed += not works
                    if works:
                        self._times[kind].append(time.monotonic() - begun)


def _quantiles(times: Sequence[float]) -> str:
    found = sorted(times)
    if not found:
        return "none"
    p50, p95 = (found[min(len(found) - 1, int(part * len(found)))] for part in (0.5, 0.95))
    return f"n={len(found)} p50={1e3 * p50:.0f} ms p95={1e3 * p95:.0f} ms max={1e3 * found[-1]:.0f} ms"


def _family(pid: int) -> list[int]:
    found = [pid]
    for one in found:
        for task in Path(f"/proc/{one}/task").glob("*/children"):
            found += map(int, task.read_text().split())
    return found


def _ticks(pids: Iterable[int]) -> float:
    ticks = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def _resident_bytes(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
