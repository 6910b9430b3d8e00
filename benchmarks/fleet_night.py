"""A night of twenty parked robots and their collector, in real time: no alarm may be false, and none may be missing.

    python -m benchmarks.fleet_night --hours 12 --results night.ndjson
    python -m benchmarks.fleet_night --hours 1 --seed 3

Each robot has a real log and the real process of the pusher, behind a cable that can be cut. The collector is the
released program, with a private PostgreSQL 15. Every 15 seconds the metrics are scraped, and the shipped alerts
evaluated; `--results` gets a line for each scrape and each event.

Until 25 minutes before the end, each event is part of a healthy night: restarts, short cuts, a robot that is switched
off, a renewed certificate. Then real faults are planted, of which each has its alarm. The exit status is 1 if an alarm
was false or missing, or if a robot that could reach the collector was called silent.
"""

import argparse
import asyncio
import itertools
import json
import os
import random
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Coroutine, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import IO, Any

import httpx
from prometheus_client.core import Metric
from prometheus_client.parser import text_string_to_metric_families

from benchmarks.fleet import _family, _ticks
from benchmarks.parked_robots import ParkedRobot
from fleet.tests.support.fleet_site import FleetSite
from fleet.tests.support.postgres import PostgresCluster, postgres
from tests.support.alert_rules import Alert, FleetAlerts

_SCRAPE_SECONDS = 15.0
_PLANTED_SECONDS = 1500.0
_BACK_SECONDS = 180.0  # until a robot has surely been heard again
_LAST_SECONDS = 180.0  # for the planted full disk
_YEARS = 3 * 365 * 86_400.0
_SILENT = "RosrvFleetRobotSilent"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=12.0)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1, help="of the events and their times")
    parser.add_argument("--results", type=Path, default=Path("/dev/null"))
    given = parser.parse_args()
    if given.hours < 1:
        parser.error("--hours: give at least 1: half an hour is for the planted faults")
    folder = Path(tempfile.mkdtemp(prefix="rosrv-bench-"))
    try:
        with postgres() as cluster, given.results.open("a") as results:
            site = FleetSite(folder / "site", cluster.create("night"))
            site.write_config(retention={"index_days": 1})
            broken = asyncio.run(_Night(site, cluster, results, given).run())
    finally:
        shutil.rmtree(folder)
    raise SystemExit(1 if broken else 0)


class _Night:
    def __init__(
        self, site: FleetSite, cluster: PostgresCluster, results: IO[str], given: argparse.Namespace
    ) -> None:
        self._site, self._cluster, self._results = site, cluster, results
        self._seconds = 3600.0 * given.hours
        self._chance = random.Random(given.seed)
        self._count = given.robots
        self._robots: list[ParkedRobot] = []
        self._alerts = FleetAlerts()
        self._collector, self._database = asyncio.Lock(), asyncio.Lock()
        self._began = time.monotonic()
        self._reachable: dict[str, float] = {}
        """The times since which the collector could hear each robot."""
        self._planted: dict[Alert, float] = {}
        self._first: dict[Alert, float] = {}
        self._troubles: set[str] = set()
        self._untrue = self._scrapes = 0
        self._spent = dict.fromkeys(("collector", "PostgreSQL", "robots"), 0.0)
        self._last: dict[int, float] = {}

    @property
    def _now(self) -> float:
        return time.monotonic() - self._began

    async def run(self) -> bool:
        work: list[asyncio.Task[None]] = []
        try:
            await asyncio.to_thread(self._site.start)
            await self._start_robots()
            work += [asyncio.create_task(self._scrape()), asyncio.create_task(self._events())]
            work += [asyncio.create_task(self._traffic(robot)) for robot in self._robots[::2]]
            await asyncio.sleep(self._seconds - _PLANTED_SECONDS)
            await self._plant()
            await asyncio.sleep(self._seconds - _LAST_SECONDS - self._now)
            await self._fill_disk()
            await asyncio.sleep(self._seconds - self._now)
            for task in work:
                if task.done():
                    task.result()  # a defect of this program must not look like a quiet night
        finally:
            for task in work:
                task.cancel()
            for robot in self._robots:
                if robot.pid is not None:
                    await robot.kill()
                robot.close()
            self._site.kill()
        return self._judge()

    async def _start_robots(self) -> None:
        for number in range(self._count):
            ahead = self._chance.uniform(-5.0, 5.0)
            robot = ParkedRobot(self._site, f"robot{number:02}", removes=number % 4 == 0, ahead=ahead)
            self._robots.append(robot)
            robot.note(3)  # of its start
            await robot.start()
            self._reachable[robot.name] = self._now
        self._say("begun", robots=self._count, hours=self._seconds / 3600)

    # --- what is seen ---

    async def _scrape(self) -> None:
        for number in itertools.count(1):
            await asyncio.sleep(max(0.0, number * _SCRAPE_SECONDS - self._now))
            metrics = await asyncio.to_thread(self._metrics)
            now = self._now
            firing = self._alerts.firing(now, metrics)
            for alert in firing:
                self._first.setdefault(alert, now)
            silent, off = (_robots_with(f"rosrv_fleet_robot_{word}", metrics) for word in ("silent", "off"))
            untrue = [name for name in silent if now - self._reachable.get(name, now) > _BACK_SECONDS]
            self._untrue += len(untrue)
            troubles = {robot.name: robot.report.trouble for robot in self._robots if robot.report.trouble}
            self._troubles.update(re.sub("[0-9]+", "N", reason) for reason in troubles.values())
            self._scrapes += 1
            self._count_processor_time()
            self._say(
                "scraped", up=metrics is not None, firing=sorted(firing), silent=silent, off=off, untrue=untrue,
                trouble=troubles,
            )  # fmt: skip

    def _metrics(self) -> list[Metric] | None:
        try:
            answer = self._site.get("/metrics")
        except httpx.TransportError:
            return None
        return list(text_string_to_metric_families(answer.text)) if answer.status_code == 200 else None

    def _count_processor_time(self) -> None:
        found = {
            "collector": [] if self._collector.locked() else _family(self._site.pid),
            "PostgreSQL": [] if self._database.locked() else _family(self._cluster.pid),
            "robots": [robot.pid for robot in self._robots if robot.pid is not None],
        }
        for part, pids in found.items():
            for pid in pids:
                try:
                    ticks = _ticks([pid])
                except FileNotFoundError:
                    continue
                self._spent[part] += ticks - self._last.get(pid, 0.0)
                self._last[pid] = ticks

    def _say(self, event: str, **fields: Any) -> None:
        line = {"at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "seconds": round(self._now, 1)}
        print(json.dumps(line | {"event": event} | fields), file=self._results, flush=True)
        if event != "scraped":
            print(f"{line['at']} {event}", *(f"{name}={value}" for name, value in fields.items()), flush=True)

    # --- a healthy night ---

    async def _traffic(self, robot: ParkedRobot) -> None:
        while True:
            await asyncio.sleep(self._chance.expovariate(1 / 240.0))
            if robot.signs:
                robot.note(self._chance.randint(1, 20))

    async def _events(self) -> None:
        kinds: Sequence[Callable[[], Coroutine[Any, Any, None]]] = (
            self._switch_off, self._restart_collector, self._stop_database, self._cut_one, self._cut_all,
            self._kill_collector, self._renew, self._restart_process,
        )  # fmt: skip
        end = self._seconds - _PLANTED_SECONDS
        rounds = max(1, round(self._seconds / 7200))
        times = sorted(self._chance.uniform(60.0, end - 780.0) for _event in kinds * rounds)
        order = [kind for _round in range(rounds) for kind in self._chance.sample(kinds, len(kinds))]
        order.remove(self._switch_off)
        order.insert(0, self._switch_off)
        async with asyncio.TaskGroup() as group:
            for when, kind in zip(times, order, strict=True):
                await asyncio.sleep(max(0.0, when - self._now))
                group.create_task(kind())

    async def _free_robot(self) -> ParkedRobot:
        while True:
            robot = self._chance.choice(self._robots)
            if not robot.lock.locked():
                return robot
            await asyncio.sleep(1.0)

    async def _switch_off(self) -> None:
        robot = await self._free_robot()
        async with robot.lock:
            seconds = self._chance.uniform(0.5, 0.9) * (self._seconds - _PLANTED_SECONDS - self._now)
            self._say("shut down cleanly", robot=robot.name, minutes=round(seconds / 60))
            self._reachable.pop(robot.name)
            await robot.switch_off()
            await asyncio.sleep(seconds)
            await robot.start()
            self._reachable[robot.name] = self._now
            self._say("switched on", robot=robot.name)
            await asyncio.sleep(_BACK_SECONDS)

    async def _restart_collector(self) -> None:
        async with self._collector:
            seconds = self._chance.uniform(1.0, 90.0)
            self._say("collector stopped", seconds=round(seconds))
            await asyncio.to_thread(self._site.stop)
            await asyncio.sleep(seconds)
            await asyncio.to_thread(self._site.start)
            self._say("collector started")

    async def _kill_collector(self) -> None:
        async with self._collector:
            self._say("collector killed")
            await asyncio.to_thread(self._site.kill)
            await asyncio.to_thread(self._site.start)

    async def _stop_database(self) -> None:
        async with self._database:
            seconds = self._chance.uniform(60.0, 230.0)
            self._say("PostgreSQL stopped", seconds=round(seconds))
            await asyncio.to_thread(self._cluster.stop)
            await asyncio.sleep(seconds)
            await asyncio.to_thread(self._cluster.start)
            self._say("PostgreSQL started")
            await asyncio.sleep(_BACK_SECONDS)

    async def _cut_one(self) -> None:
        robot = await self._free_robot()
        await self._cut([robot], self._chance.uniform(60.0, 360.0))

    async def _cut_all(self) -> None:
        await self._cut([robot for robot in self._robots if not robot.lock.locked()], 120.0)

    async def _cut(self, robots: Sequence[ParkedRobot], seconds: float) -> None:
        async with AsyncExitStack() as locks:
            for robot in robots:
                await locks.enter_async_context(robot.lock)
            self._say("cut", robots=[robot.name for robot in robots], seconds=round(seconds))
            for robot in robots:
                robot.cable.cut()
                self._reachable.pop(robot.name)
            await asyncio.sleep(seconds)
            for robot in robots:
                robot.cable.join()
                self._reachable[robot.name] = self._now
            self._say("joined", robots=[robot.name for robot in robots])
            await asyncio.sleep(_BACK_SECONDS)

    async def _renew(self) -> None:
        robot = await self._free_robot()
        async with robot.lock:
            self._say("certificate renewed", robot=robot.name)
            await asyncio.to_thread(robot.renew)
            await asyncio.sleep(_BACK_SECONDS)

    async def _restart_process(self) -> None:
        robot = await self._free_robot()
        async with robot.lock:
            self._say("pusher killed", robot=robot.name)
            await robot.kill()
            await robot.start()
            await asyncio.sleep(_BACK_SECONDS)

    # --- real faults ---

    async def _plant(self) -> None:
        cut, unplugged, keyless, edited, ahead = self._chance.sample(self._robots, 5)
        for robot in (cut, unplugged, keyless, edited, ahead):
            await robot.lock.acquire()
        faults = zip(
            ("cable cut", "unplugged", "signing key lost", "log edited", "clock years ahead"),
            (cut, unplugged, keyless, edited, ahead),
            strict=True,
        )
        for fault, robot in faults:
            self._reachable.pop(robot.name)
            self._planted[Alert(_SILENT, robot.name)] = self._now
            self._say("planted", fault=fault, robot=robot.name)
        cut.cable.cut()
        await unplugged.kill()
        keyless.signs = False
        keyless.note(3)
        edited.signs = False  # until the record is edited
        edited.note(3)
        await asyncio.sleep(2.0)
        edited.edit_log()
        edited.signs = True
        edited.log.request_signatures()
        await ahead.kill()
        ahead.ahead = _YEARS
        await ahead.start()
        await self._database.acquire()
        self._planted[Alert("RosrvFleetIndexDown")] = self._now
        self._say("planted", fault="PostgreSQL stopped")
        await asyncio.to_thread(self._cluster.stop)

    async def _fill_disk(self) -> None:
        await self._collector.acquire()
        self._say("planted", fault="disk full")
        self._planted[Alert("RosrvFleetDiskFull")] = self._now
        await asyncio.to_thread(self._site.stop)
        self._site.write_config(limits={"reserve_bytes": 1 << 60})
        await asyncio.to_thread(self._site.start)
        self._collector.release()

    # --- the end ---

    def _judge(self) -> bool:
        false = {alert: at for alert, at in self._first.items() if at < self._planted.get(alert, 1e9)}
        missing = self._planted.keys() - self._first.keys()
        for alert, at in sorted(self._planted.items()):
            after = self._first.get(alert)
            self._say(
                "alarm",
                name=alert.name,
                robot=alert.robot,
                after=None if after is None else round(after - at),
            )
        for reason in sorted(self._troubles):
            self._say("reported on a robot", trouble=reason)
        spent = {part: f"{100 * seconds / self._now:.1f} %" for part, seconds in self._spent.items()}
        self._say(
            "ended", scrapes=self._scrapes, false=sorted(false.items()), missing=sorted(missing), untrue=self._untrue,
            processor=spent, load=os.getloadavg()[2],
        )  # fmt: skip
        return bool(false or missing or self._untrue)


def _robots_with(metric: str, metrics: list[Metric] | None) -> list[str]:
    return sorted(
        sample.labels["robot"]
        for family in metrics or ()
        for sample in family.samples
        if sample.name == metric and sample.value
    )


if __name__ == "__main__":
    main()
