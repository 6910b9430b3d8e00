import contextlib
import gzip
import secrets
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest
from rosrv_fleet.collector import make_collector
from rosrv_fleet.config import load_config

from appliance.formats.segments import SegmentSummary
from fleet.tests.support.fleet_site import FleetRobot, FleetSite, running
from fleet.tests.support.forged_segments import forged
from fleet.tests.system.test_attacks import put
from tests.support.processes import runs
from tests.support.waiting import eventually

MakeRobot = Callable[..., FleetRobot]
_ATTACKERS = 6
_RECORDS = 10_000  # of an attacker's segment: much processor time


def _push_again_and_again(
    site: FleetSite, robot: FleetRobot, summary: SegmentSummary, body: bytes, ended: threading.Event
) -> int:
    end = summary.header.end
    path = f"/v1/logs/{end.log}/segments/{end.number}/{summary.name}"
    count = 0
    while not ended.is_set():
        try:
            with site.client(robot.certificates) as client:
                answer = client.put(path, content=body, headers={"Content-Encoding": "gzip"})
        except httpx.TransportError:
            continue
        if answer.status_code == 201:
            break
        count += answer.status_code == 422
        ended.wait(0.1)
    return count


def _seen(site: FleetSite, uploads: set[str]) -> set[str]:
    assert site.data is not None
    uploads.update(path.name for path in (site.data / "incoming").iterdir())
    return uploads


@contextmanager
def _attack(site: FleetSite, attackers: list[FleetRobot], *, valid: bool) -> Iterator[None]:
    ended, log = threading.Event(), secrets.token_hex(16)
    made = [(robot, *forged(robot, _RECORDS, log=log)) for robot in attackers]
    pushed = [
        (robot, summary, gzip.compress(body if valid else body[:-2] + b" \n", 1))
        for robot, summary, body in made
    ]
    with ThreadPoolExecutor(len(attackers)) as pool:
        for attacker, summary, packed in pushed:
            pool.submit(_push_again_and_again, site, attacker, summary, packed, ended)
        try:
            if not valid:
                uploads: set[str] = set()
                eventually(lambda: len(_seen(site, uploads)) >= len(attackers), "the attack runs")
            yield
        finally:
            ended.set()


def _found(site: FleetSite, robot: str, sequence: int) -> bool:
    return any(one["sequence"] == sequence for one in site.search(robot=robot, limit=1000))


@pytest.mark.parametrize("valid", [False, True])
def test_others_are_served_while_robots_push_large_segments(
    site: FleetSite, make_robot: MakeRobot, *, valid: bool
) -> None:
    attackers = [make_robot(f"bad{number}") for number in range(_ATTACKERS)]
    victim = make_robot("arm1")
    victim.record(5)
    with _attack(site, attackers, valid=valid):
        pusher = victim.pusher()
        eventually(lambda: pusher.step() > 0 and not pusher.progress.trouble, "the receipt")
        pusher.close()
        eventually(partial(_found, site, "arm1", victim.sealed()), "it is searchable", 300)


def test_refused_bytes_are_charged_and_survive_a_restart(database: str, tmp_path: Path) -> None:
    limits = {"robot_unpacked_bytes_per_day": 150_000}
    with running(FleetSite(tmp_path / "site", database, limits)) as site:
        bad, good = FleetRobot(site, "bad"), FleetRobot(site, "good")
        summary, body = forged(bad, 200)
        wrong = gzip.compress(body[:-2] + b" \n")
        while (answer := put(site, bad.certificates, summary, wrong)).status_code == 422:
            assert answer.json()["detail"].startswith("not a valid segment of bad")
        site.stop()
        site.start()
        answer = put(site, bad.certificates, summary, gzip.compress(body))
        assert (answer.status_code, "robot_unpacked_bytes_per_day" in answer.text) == (429, True)
        assert int(answer.headers["Retry-After"]) > 60
        good.record(5)
        good.push()
        bad.close()
        good.close()


def test_a_segment_has_a_limit_of_processor_time(database: str, tmp_path: Path) -> None:
    with running(FleetSite(tmp_path / "site", database, {"check_seconds": 0.5})) as site:
        bad = FleetRobot(site, "bad")
        summary, body = forged(bad, 10)
        bomb = gzip.compress(b"", 1) * 1_000_000 + gzip.compress(body)
        answer = put(site, bad.certificates, summary, bomb)
        assert (answer.status_code, "processor time" in answer.text) == (422, True)
        bad.close()


def test_workers_end_with_the_collector(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    for end in (site.kill, site.stop):
        robot.record(5)
        robot.push()
        workers = _descendants(site.pid)
        assert workers
        end()
        eventually(lambda: not any(map(runs, workers)), "all workers have ended")  # noqa: B023  called here
        site.start()


def _descendants(process: int) -> list[int]:
    descendants = []
    for task in Path(f"/proc/{process}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # the thread has ended
            for child in map(int, (task / "children").read_text().split()):
                descendants += [child, *_descendants(child)]
    return descendants


def test_no_content_of_a_segment_stops_the_index(site: FleetSite, make_robot: MakeRobot) -> None:
    bad, good = make_robot("bad"), make_robot("good")
    name = "/" + "".join(secrets.choice("abcdefghijklmnopqrstuvwxyz0123456789ÄÖ漢") for _ in range(4000))
    fields: dict[str, Any] = {
        "id": name,
        "host": name,
        "caller_id": name,
        "resource": name,
        "category": name,
        "decision": name,
    }
    summary, body = forged(bad, 3, **fields)
    assert put(site, bad.certificates, summary, gzip.compress(body)).status_code == 201
    good.record(5)
    good.push()
    site.indexed()
    assert len(site.search(robot="good", event="decision")) == 5
    assert len(site.search(robot="bad", topic=name[:100] + "*")) == 3
    site.run("verify", "bad")


def test_a_damaged_segment_stops_no_other(site: FleetSite, make_robot: MakeRobot) -> None:
    bad, good = make_robot("bad"), make_robot("good")
    bad.record(5)
    bad.push()
    site.stop()
    assert site.data is not None
    (file,) = (site.data / "segments" / "bad").rglob("*.gz")
    whole = file.read_bytes()
    file.write_bytes(whole[:-30])
    waiting = site.data / "pending" / "bad"
    waiting.mkdir(exist_ok=True)
    (log, (number, _, name)) = (file.parent.parent.name, file.name.partition(".")[0].partition("-"))
    with psycopg.connect(site.database) as connection:
        connection.execute("TRUNCATE segment, record")
    (waiting / f"{log}~{number}~{name}").touch()
    site.start()
    good.record(5)
    good.push()
    eventually(lambda: _found(site, "good", good.sealed()), "the other robot is searchable")
    eventually(lambda: "verify bad" in (site.health()["trouble"] or ""), "the damage is reported")
    eventually(lambda: site.health()["waiting"] == 1, "only the damaged segment waits")
    every_hour(site)
    tried = site.data / "large" / "bad"
    eventually(lambda: not tried.exists(), "it was tried again")
    assert (site.health()["waiting"], "verify bad" in site.health()["trouble"]) == (1, True)
    file.write_bytes(whole)
    every_hour(site)
    site.indexed()
    assert len(site.search(robot="bad", event="decision")) == 5


def every_hour(site: FleetSite) -> None:
    collector = make_collector(load_config(site.folder / "fleet.yaml"))
    collector.database.open()
    collector.pruner.step()
    collector.database.close()


def test_a_robot_hides_no_gap_of_another(site: FleetSite, make_robot: MakeRobot) -> None:
    bad, good = make_robot("bad"), make_robot("good")
    log = secrets.token_hex(16)
    answers = []
    for _ in range(17):
        summary, body = forged(bad, 1, log=log, number=5)
        answers.append(put(site, bad.certificates, summary, gzip.compress(body)))
    assert [answer.status_code for answer in answers] == [201] * 16 + [409]
    assert "16 segments have the number 5" in answers[-1].text
    good.record(5)
    good.push()
    forks = {robot["name"]: robot["forks"] for robot in site.health()["robots"]}
    assert forks == {"bad": 16, "good": 0}
    assert "seals two histories" in site.run("verify", "bad", status=1).stdout
