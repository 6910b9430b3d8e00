"""Random faults of a pair of appliances, each with what the robot's nodes and the operators noticed.

    python -m benchmarks.pair_faults --faults 150 --seed 1 [--load 0] [--only TEXT] [--results FILE]

The seed determines the list of faults. With `--results`, another run with the same file continues after the last
fault.

The columns are: the longest time in seconds without an answer of the Master API, a message, and an answer of a
service (from the end of the fault if no appliance could serve before); the subscriptions that were not back 20 s
after the fault; the holder of the lease before and after; the answer of `standby status` near the end of the fault,
and the seconds until it came; `two`, the changes of the answering appliance that no grant of the witness explains, as
an unfenced outsider sees them. The last column has broken promises, and with one the exit status is 1.
"""

import argparse
import contextlib
import itertools
import json
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.table import Table

from appliance.cli.connection.admin_client import AdminSocket, NotRunningError
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.answers import StandbyState
from appliance.features.standby.membership import load_membership, path_of, save_membership
from appliance.features.standby.summary import standby_troubles
from benchmarks.pair_fault_kinds import Fault, drawn
from benchmarks.standby import Successes, Watch, busy
from examples.landshark.lab import Lab
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import ADDRESSES, MASTER_PORT, OCU, StandbySite
from tests.support.processes import Process
from tests.support.small_disk import small_disk
from tests.support.waiting import eventually

_RATE = 20
_BACK_SECONDS = 20.0  # until a subscription counts as lost
_WATCHED_SECONDS = 2.0
_WAIT_SHARE = 0.8 / 3.0  # of the limit, for a call that waits because the standby is away
QUIET_SECONDS, BUSY_SECONDS = 3.0, 5.0
"""The longest time without service on a quiet machine, and at load 10."""
_PROBE = Path(__file__).resolve().parent.parent / "tests" / "support" / "master_probe.py"
_NEVER = threading.Event()


@dataclass
class Noticed:
    number: int
    fault: str
    seconds: float
    api: float = 0.0
    topics: float = 0.0
    services: float = 0.0
    lost: int = 0
    holder: str = ""
    said: dict[str, str] = field(default_factory=dict)
    asked: dict[str, float] = field(default_factory=dict)
    orders: list[str] = field(default_factory=list)
    two: int = 0
    broken: list[str] = field(default_factory=list)
    whole: bool = True
    story: str = ""


class Statuses:
    def __init__(self, site: StandbySite) -> None:
        self.said: dict[str, str] = {}
        self.seconds: dict[str, float] = {}
        self._threads = [
            threading.Thread(target=self._ask, args=(name, appliance.state))
            for name, appliance in site.appliances.items()
        ]
        for thread in self._threads:
            thread.start()

    def _ask(self, name: str, state: Path) -> None:
        began = time.monotonic()
        try:
            answer = AdminSocket(state).ask(standby_requests.StandbyWanted())
            text = _judgement(answer.unwrap()) if answer.ok else answer.error
        except NotRunningError as error:
            text = str(error).partition(": ")[2]
        self.said[name], self.seconds[name] = text, time.monotonic() - began

    def join(self) -> None:
        for thread in self._threads:
            thread.join()


def _judgement(state: StandbyState) -> str:
    return f"{state.role}: {'; '.join(trouble.kind for trouble in standby_troubles(state)) or 'OK'}"


def answered_by_two(events: list[dict[str, object]], grants: int) -> int:
    by = [event["by"] for event in events if event.get("event") == "answered"]
    changes = sum(here != there for here, there in itertools.pairwise(by))
    return max(0, changes - grants)


def suffer(
    site: StandbySite, robot: StandbyRobot, probe: Process, row: Noticed, fault: Fault
) -> list[Process]:
    active, passive = site.pair()
    epoch, mark = site.lease.read().epoch, probe.mark()
    with Watch(robot) as watch:
        with fault.make(site, active, passive, row.orders):
            _NEVER.wait(row.seconds)
            statuses = Statuses(site)
            _NEVER.wait(0.1)
        ended = time.monotonic()
        back = {name: max(_until_back(one, ended) for one in these) for name, these in watch.found.items()}
        _NEVER.wait(_WATCHED_SECONDS)
        again = time.monotonic()
        lost = [one for one, seen in watch.topics.items() if _until_back(seen, again) >= _BACK_SECONDS]
    statuses.join()
    times = back if fault.cut_off else watch.longest_pauses()
    row.api = times["Master API"]
    row.topics = max(seconds for name, seconds in times.items() if name.startswith("topic"))
    row.services = max(seconds for name, seconds in times.items() if name.startswith("service"))
    row.said, row.asked, row.lost = statuses.said, statuses.seconds, len(lost)
    eventually(lambda: site.in_sync() == {"a", "b"}, site.story)
    row.holder = f"{active} {site.holder()}"
    row.two = answered_by_two(probe.events[mark:], site.lease.read().epoch - epoch)
    return lost


def judge(row: Noticed, fault: Fault, limit: float) -> None:
    allowed = limit * (_WAIT_SHARE if fault.goes_on else 1.0)
    allowed += row.seconds if fault.interrupts or fault.cut_off else 0.0
    for what, seconds in (("Master API", row.api), ("topics", row.topics), ("services", row.services)):
        if seconds > allowed:
            row.broken.append(f"{what} away {seconds:.1f} s")
    row.broken += [f"status of {name} took {took:.1f} s" for name, took in row.asked.items() if took > limit]
    if row.lost:
        row.broken.append(f"{row.lost} subscriptions lost")
    if row.two:
        row.broken.append("two appliances answered")


def _until_back(successes: Successes, moment: float) -> float:
    try:
        return successes.until_after(moment, _BACK_SECONDS) - moment
    except TimeoutError:
        return _BACK_SECONDS


def _start_again(robot: StandbyRobot, lost: list[Process]) -> None:
    for listener in lost:
        robot.listeners.remove(listener)
        listener.stop()
        robot.ros.processes.remove(listener)
        robot.listeners.append(robot.ros.start(listener.command, label=listener.label))


@contextlib.contextmanager
def running_site() -> Iterator[tuple[StandbySite, Process]]:
    with contextlib.ExitStack() as stack:
        home = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        disk = stack.enter_context(small_disk(home / "robot", "1m"))
        lab = stack.enter_context(Lab("rosrv-rig"))
        site = stack.enter_context(StandbySite(lab, home, lease_folder=disk))
        for appliance in site.appliances.values():
            member = load_membership(path_of(appliance.state))
            assert member is not None
            stack.enter_context(small_disk(appliance.state, "400m", "mode=0711"))
            save_membership(path_of(appliance.state), member)
        site.start_witness()
        site.start("a")
        site.until_active("a")
        site.start("b")
        site.until_both_in_sync()
        command = [sys.executable, str(_PROBE)]
        command += [f"{name}=http://{address}:{MASTER_PORT}" for name, address in ADDRESSES.items()]
        probe = Process(lab.host("ocu", f"{OCU}/24"), command, env={}, label="probe")
        stack.callback(probe.stop)
        yield site, probe


def until_whole(site: StandbySite, robot: StandbyRobot) -> None:
    """Wait until the robot admits only the holder, and both appliances report no trouble and no lost change."""
    robot.lost_nothing()
    eventually(lambda: robot.admitted() == {ADDRESSES[site.holder()]}, site.story)
    wanted = standby_requests.StandbyWanted()
    for appliance in site.appliances.values():
        eventually(partial(lambda it: not it.ask(wanted).troubles, appliance), site.story)


def one(
    site: StandbySite, robot: StandbyRobot, probe: Process, row: Noticed, fault: Fault, *, limit: float
) -> None:
    """Measure and judge a fault. A row with a broken promise gets the output of all programs as its `story`."""
    try:
        _start_again(robot, suffer(site, robot, probe, row, fault))
        judge(row, fault, limit)
        until_whole(site, robot)
    except (AssertionError, OSError, NotRunningError) as error:
        row.broken.append(f"not whole again: {(str(error).splitlines() or [repr(error)])[0]}")
        row.whole, row.story = False, f"{error}\n"
    if row.broken:
        row.story += "\n".join([site.story(), robot.ros.story()])


def run(faults: Sequence[tuple[Fault, float]], *, done: int, load: int, limit: float) -> Iterator[Noticed]:
    """Yield a row for each fault after the first `done`. A site that did not recover is made again."""
    while done < len(faults):
        with running_site() as (site, probe), StandbyRobot(site, rate=_RATE) as robot, busy(load):
            for fault, seconds in faults[done:]:
                done += 1
                row = Noticed(done, fault.name, round(seconds, 2))
                one(site, robot, probe, row, fault, limit=limit)
                yield row
                if not row.whole:
                    break


def read(results: Path | None) -> list[Noticed]:
    if results is None or not results.exists():
        return []
    return [Noticed(**json.loads(line)) for line in results.read_text().splitlines()]


def keep(row: Noticed, results: Path | None) -> None:
    line = json.dumps({name: value for name, value in asdict(row).items() if name != "story"})
    print(line, flush=True)
    if results is None:
        return
    with results.open("a") as file:
        file.write(f"{line}\n")
    if row.story:
        results.with_suffix(f".{row.number}.log").write_text(row.story)


def shown(rows: list[Noticed]) -> Table:
    heads = (
        "",
        "fault",
        "s",
        "API",
        "topics",
        "services",
        "lost",
        "holder",
        "a says",
        "b says",
        "two",
        "broken",
    )
    table = Table(
        *heads, title=f"{len(rows)} faults, {sum(bool(row.broken) for row in rows)} with a broken promise"
    )
    for row in rows:
        times = (f"{seconds:.2f}" for seconds in (row.seconds, row.api, row.topics, row.services))
        said = (f"{row.said.get(name, '')} ({row.asked.get(name, 0):.1f} s)" for name in ADDRESSES)
        broken = "; ".join([*row.broken, *row.orders])
        table.add_row(
            str(row.number), row.fault, *times, str(row.lost), row.holder, *said, str(row.two), broken
        )
    return table


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--faults", type=int, default=150)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--load", type=int, default=0, help="processes that compute")
    arguments.add_argument("--only", default="", help="faults whose name contains this text")
    arguments.add_argument("--results", type=Path, help="file to which each fault adds a line")
    given = arguments.parse_args()
    rows = read(given.results)
    faults = [one for one in drawn(given.faults, given.seed) if given.only in one[0].name]
    limit = BUSY_SECONDS if given.load else QUIET_SECONDS
    for row in run(faults, done=len(rows), load=given.load, limit=limit):
        keep(row, given.results)
        rows.append(row)
    Console(width=200).print(shown(rows))
    sys.exit(1 if any(row.broken for row in rows) else 0)


if __name__ == "__main__":
    main()
