import asyncio
import json
import shutil
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from rosrv_fleet.console.rollout_pages import group_page, groups_page
from rosrv_fleet.enrolment import RobotGroup
from rosrv_fleet.rollouts.machine import BundleRollout
from rosrv_fleet.rollouts.service import RolloutRefusedError

from appliance.features.fleet.bundle_link import BundleHealth, BundleOffered, BundleStated, RefusedBundle
from appliance.features.fleet.connection import robot_context
from appliance.features.fleet.process import Poller
from appliance.formats.terms import BundlePath, Ring
from fleet.tests.support.bundle_site import GROUP, SITE, bundle_files, everywhere
from fleet.tests.support.postgres import PostgresCluster
from tests.support.processes import LIMIT
from tests.support.rollout_collector import RolloutCollector, collector, serving
from tests.support.waiting import NoAnswerError, eventually
from tests.unit.features.fleet.robot_site import RobotSite

QUICK = {"healthy_seconds": 0, "share": 0.9}
RINGS = (Ring("canary", ["r-0", "r-1"]), Ring("half", [], 50), Ring("rest", [], 100))


@dataclass
class Robot:
    name: str
    poller: Poller
    judge: Callable[[BundleOffered], str]
    stated: BundleStated = field(default_factory=BundleStated)
    taken: list[str] = field(default_factory=list)

    def offered(self, bundle: BundleOffered) -> None:
        reason = self.judge(bundle)
        if reason:
            refused = RefusedBundle(bundle.path, bundle.sha256, reason)
            self.stated = BundleStated(self.stated.in_force, self.stated.sha256, refused=refused)
        else:
            self.taken.append(bundle.path)
            self.stated = BundleStated(bundle.path, bundle.sha256, health=self.stated.health)

    def deny(self, denials: int) -> None:
        self.stated = BundleStated(self.stated.in_force, self.stated.sha256, health=BundleHealth(denials))


class Fleet:
    def __init__(self, site: RobotSite, running: RolloutCollector, folder: Path) -> None:
        self.site, self.collector, self.folder = site, running, folder
        self.robots: dict[str, Robot] = {}
        certificate, key = site.authority.issue("operator")
        self.operator = httpx.Client(
            base_url=running.url, verify=_context(site, certificate, key), timeout=30, trust_env=False
        )

    def add(self, count: int) -> None:
        for _ in range(count):
            name = f"r-{len(self.robots)}"
            self.collector.enrol(RobotGroup(SITE, GROUP), name)
            client = self.site.robot(self.collector.url, self.folder / name, name)
            robot = Robot(
                name,
                Poller(client, client.connection, (SITE, GROUP), 60, BundleStated, print),
                lambda _bundle: "",
            )
            robot.poller.stated = lambda robot=robot: robot.stated  # type: ignore[misc]  # mypy infers no type for a lambda's default
            robot.poller.offer = robot.offered
            self.robots[name] = robot

    def poll(self, *names: str) -> None:
        wanted = [self.robots[name] for name in names] or list(self.robots.values())
        parts = [wanted[start::6] for start in range(6)]

        def run(part: list[Robot]) -> None:
            for robot in part:
                robot.poller.report_due = 0.0  # report each time
                robot.poller.step()
                robot.poller.report_due = 0.0
                robot.poller.report()

        threads = [threading.Thread(target=run, args=(part,)) for part in parts]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def publish(self, *rings: Ring, **files: str) -> BundlePath:
        return self.site.repository.add(SITE, GROUP, bundle_files(**files), everywhere(None, *rings))

    def start(self, path: BundlePath, **gates: Any) -> dict[str, Any]:
        def there() -> bool:
            publication = self.collector.service.publisher.publication
            return publication is not None and str(path) in publication.bundles

        eventually(there, f"{path} is published: {self.collector.service.publisher.trouble}")
        answer = self.operator.post("/v1/rollouts", json={"bundle": str(path), "gates": QUICK | gates})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    def state(self) -> dict[str, Any]:
        answer = self.operator.get(f"/v1/rollouts/{SITE}/{GROUP}")
        found = answer.json()["rollout"] if answer.status_code == 200 else None
        if found is None:
            raise NoAnswerError(answer.text)
        return dict(found)

    def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        def found() -> dict[str, Any] | None:
            self.poll()
            state = self.state()
            return state if wanted(state) else None

        return eventually(found, lambda: json.dumps(self.state()), 6 * LIMIT)


def _nameless(fleet: Fleet) -> httpx.Client:
    return httpx.Client(verify=ssl.create_default_context(cafile=fleet.site.authority.ca), trust_env=False)


def _context(site: RobotSite, certificate: Path, key: Path) -> Any:
    return robot_context(site.authority.ca, certificate, key)


@pytest.fixture
def fleet(tmp_path: Path, database: str) -> Iterator[Fleet]:
    site = RobotSite(tmp_path / "site")
    with collector(site.repository.folder, site.authority, database) as running:
        made = Fleet(site, running, tmp_path)
        try:
            yield made
        finally:
            made.operator.close()
            for opened in site.connections:
                opened.close()


def test_a_rollout_reaches_all_robots_ring_by_ring(fleet: Fleet) -> None:
    fleet.add(54)
    path = fleet.publish(*RINGS)
    eventually(lambda: fleet.collector.service.publisher.timestamp is not None, "a timestamp")
    fleet.poll()
    fleet.start(path, share=1)
    fleet.poll(*list(fleet.robots)[2:])
    assert not any(robot.taken for robot in fleet.robots.values())
    state = fleet.until(lambda state: state["state"] == "done")
    assert [ring["in_force"] for ring in state["rings"]] == [ring["robots"] for ring in state["rings"]]
    assert all(robot.taken == [str(path)] for robot in fleet.robots.values())


def test_a_bad_canary_stops_the_rollout(fleet: Fleet) -> None:
    fleet.add(52)
    fleet.robots["r-0"].judge = lambda _bundle: "policy.ini:3:1: error: <script>"
    path = fleet.publish(*RINGS)
    eventually(lambda: fleet.collector.service.publisher.timestamp is not None, "a timestamp")
    fleet.poll()
    fleet.start(path)
    state = fleet.until(lambda state: state["state"] == "stopped")
    assert "refused: policy.ini:3:1" in state["why"]
    service = fleet.collector.service
    pages = groups_page(service) + group_page(service, RobotGroup(SITE, GROUP), may_change=True)
    assert '<span class="badge bad">stopped</span>' in pages
    assert "error: &lt;script&gt;" in pages
    assert "<script>" not in pages
    fleet.poll()
    assert {name for name, robot in fleet.robots.items() if robot.taken} <= {"r-1"}


def test_denials_three_times_as_frequent_stop_the_rollout(fleet: Fleet) -> None:
    fleet.add(8)
    first = fleet.publish(Ring("all", [], 100))
    eventually(lambda: fleet.collector.service.publisher.timestamp is not None, "a timestamp")
    for robot in fleet.robots.values():
        robot.deny(5)
    fleet.poll()
    fleet.start(first)
    fleet.until(lambda state: state["state"] == "done")
    second = fleet.publish(*RINGS, policy_dot_ini="[Nodes]\n")
    fleet.start(second, healthy_seconds=600)
    fleet.until(lambda state: state["rings"][0]["in_force"] == 2)
    fleet.robots["r-1"].deny(15)
    state = fleet.until(lambda state: state["state"] == "stopped")
    assert "15 denials a minute, 5 before" in state["why"]
    answer = fleet.operator.post(f"/v1/rollouts/{SITE}/{GROUP}/revert")
    assert answer.status_code == 200, answer.text
    fleet.poll()
    assert {robot.stated.in_force for robot in fleet.robots.values()} == {str(first)}


def test_a_robot_speaks_for_itself_only(fleet: Fleet) -> None:
    fleet.add(1)
    fleet.poll()
    eventually(
        lambda: set(fleet.collector.service.robots.get(RobotGroup(SITE, GROUP), ())) == {"r-0"}, "it reported"
    )
    certificate, key = fleet.site.authority.issue("r-0")
    with httpx.Client(verify=_context(fleet.site, certificate, key), trust_env=False) as robot:
        assert robot.get(f"{fleet.collector.url}/v1/rollouts").status_code == 403
        assert robot.post(f"{fleet.collector.url}/v1/rollouts/{SITE}/{GROUP}/stop").status_code == 403
    with pytest.raises(httpx.HTTPError), _nameless(fleet) as nameless:
        nameless.get(f"{fleet.collector.url}/v1/bundles/metadata/timestamp.json")


def test_an_event_wakes_the_robot(fleet: Fleet) -> None:
    fleet.add(1)
    path = fleet.publish(Ring("all", [], 100))
    eventually(lambda: fleet.collector.service.publisher.timestamp is not None, "a timestamp")
    fleet.poll()
    woken = threading.Event()
    connection = fleet.site.connection(fleet.collector.url, "r-0")

    def listen() -> None:
        for part in connection.events(f"v1/bundles/events/{SITE}/{GROUP}"):
            if b"event: selection" in part:
                woken.set()
                return

    thread = threading.Thread(target=listen)
    thread.start()
    eventually(lambda: fleet.collector.service.listeners, "the robot listens")
    fleet.start(path)
    assert woken.wait(20)
    thread.join()
    woken.clear()
    listen()  # a robot that was away during the event is woken when it connects again
    assert woken.is_set()


def test_a_stream_ends_that_opens_while_the_collector_stops(fleet: Fleet) -> None:
    fleet.add(1)
    fleet.collector.service.end_streams()
    connection = fleet.site.connection(fleet.collector.url, "r-0")
    parts = list(connection.events(f"v1/bundles/events/{SITE}/{GROUP}"))
    assert b"event: selection" not in b"".join(parts)


def test_half_of_a_publication_is_not_served(fleet: Fleet) -> None:
    service = fleet.collector.service
    fleet.publish(Ring("all", [], 100))
    eventually(
        lambda: service.publisher.timestamp is not None and not service.publisher.trouble, "a timestamp"
    )
    before = service.publisher.timestamp
    hidden = fleet.folder / "hidden"
    fleet.publish(Ring("all", [], 100), policy_dot_ini="[Nodes]\n# other\n")
    archive = max(
        (fleet.site.repository.targets / SITE / GROUP).iterdir(), key=lambda path: path.stat().st_mtime_ns
    )
    shutil.move(archive, hidden)
    fleet.site.repository.sign()
    eventually(lambda: "publish it again" in service.publisher.trouble, lambda: service.publisher.trouble)
    shutil.move(hidden, archive)
    eventually(
        lambda: not service.publisher.trouble and service.publisher.timestamp != before,
        lambda: service.publisher.trouble,
    )


def _put(fleet: Fleet, name: str, **changes: Any) -> httpx.Response:
    report: dict[str, Any] = dict.fromkeys(("in_force", "trying", "refused", "reason", "trouble"), "")
    report |= {"site": SITE, "group": GROUP, "changed": False, "denials": 0, "failing": 0} | changes
    certificate, key = fleet.site.authority.issue(name)
    with httpx.Client(verify=_context(fleet.site, certificate, key), timeout=30, trust_env=False) as robot:
        return robot.put(f"{fleet.collector.url}/v1/bundles/report", json=report)


def test_a_robot_of_another_group_has_no_part_in_a_rollout(fleet: Fleet) -> None:
    fleet.add(2)
    other = RobotGroup(SITE, "legs")
    fleet.collector.enrol(other, "liar")
    path = fleet.publish(*RINGS)
    fleet.poll()
    fleet.start(path)
    answer = _put(fleet, "liar", refused=str(path), reason="a lie")
    assert answer.status_code == 403
    assert "liar is enrolled in site-a/legs, not in site-a/arms" in answer.text
    assert "rosrv-fleet robot group liar SITE/GROUP" in answer.text
    certificate, key = fleet.site.authority.issue("liar")
    with httpx.Client(verify=_context(fleet.site, certificate, key), trust_env=False) as robot:
        for place in ("selection/{}", "events/{}", "targets/{}/" + "0" * 64 + ".1.tar"):
            url = f"{fleet.collector.url}/v1/bundles/{place.format(f'{SITE}/{GROUP}')}"
            assert robot.get(url).status_code == 403
    fleet.until(lambda state: state["state"] == "done")
    assert set(fleet.collector.service.robots) == {RobotGroup(SITE, GROUP), other}
    fleet.collector.enrol(other, "r-1")
    eventually(lambda: len(fleet.collector.service.robots[other]) == 2, "r-1 has moved")
    assert _put(fleet, "r-1").status_code == 403
    assert _put(fleet, "nobody").status_code == 403


def test_enrolled_robots_that_never_reported_are_visible(fleet: Fleet) -> None:
    fleet.add(2)
    fleet.collector.enrol(RobotGroup(SITE, GROUP), "absent")
    path = fleet.publish(Ring("all", [], 100))
    fleet.poll()
    fleet.start(path)
    fleet.until(lambda state: state["state"] == "done")
    robots = fleet.operator.get(f"/v1/rollouts/{SITE}/{GROUP}").json()["robots"]
    assert {robot["name"]: robot["condition"] for robot in robots} == {
        "absent": "never seen",
        "r-0": "in force",
        "r-1": "in force",
    }


@pytest.mark.parametrize(
    ("lie", "reason"),
    [
        ({"in_force": "../../x"}, "not SITE/GROUP/VERSION.tar"),
        ({"trying": "latest"}, "not SITE/GROUP/VERSION.tar"),
        ({"denials": -1}, "not between 0"),
        ({"failing": 2_000_000_000}, "not between 0"),
    ],
)
def test_an_impossible_report_is_rejected(fleet: Fleet, lie: dict[str, Any], reason: str) -> None:
    fleet.add(1)
    answer = _put(fleet, "r-0", **lie)
    assert answer.status_code == 422
    assert reason in answer.text
    assert not fleet.collector.call(_seen(fleet, "r-0"))


async def _seen(fleet: Fleet, name: str) -> bool:
    await fleet.collector.service.tick()
    return fleet.collector.service.robots[RobotGroup(SITE, GROUP)][name].seen > 0


def test_a_reason_with_a_null_character_stops_only_its_rollout(fleet: Fleet) -> None:
    fleet.add(2)
    path = fleet.publish(*RINGS)
    fleet.poll()
    fleet.start(path)
    assert _put(fleet, "r-0", refused=str(path), reason="x\0y").status_code == 204
    state = eventually(
        lambda: (state := fleet.state())["state"] == "stopped" and state, lambda: json.dumps(fleet.state())
    )
    assert "refused: x\ufffdy" in state["why"]
    assert fleet.collector.service.advancing


def test_removed_robots_do_not_count(fleet: Fleet) -> None:
    fleet.add(4)
    path = fleet.publish(*RINGS)
    fleet.poll()
    fleet.robots["r-1"].judge = lambda _bundle: "never"
    fleet.start(path, healthy_seconds=600, tolerance=0.6)
    fleet.until(lambda state: state["rings"][0]["refused"] == 1)
    del fleet.collector.groups["r-1"]
    state = fleet.until(lambda state: state["rings"][0]["robots"] == 1 and state["why"] == "healthy")
    assert state["state"] == "running"
    del fleet.collector.groups["r-0"]
    state = fleet.until(lambda state: state["state"] == "stopped")
    assert state["why"] == "no robot of ring canary is enrolled in the group any more"


def test_a_restarted_collector_does_not_take_its_own_absence_for_silence(fleet: Fleet, database: str) -> None:
    fleet.add(54)
    path = fleet.publish(*RINGS)
    fleet.poll()
    fleet.start(path, healthy_seconds=600)
    fleet.until(lambda state: state["why"] == "healthy")
    made = RolloutCollector(fleet.site.repository.folder, fleet.site.authority, database, ahead=3600)
    made.enrol(RobotGroup(SITE, GROUP), *fleet.robots)
    fleet.collector.stop()
    with serving(made) as later:
        service = later.service
        stored = eventually(lambda: service.rollouts.get(RobotGroup(SITE, GROUP)), "the rollout is read")
        eventually(lambda: service.publisher.timestamp is not None, "a timestamp")
        later.call(service.tick())
        stored = service.rollouts[RobotGroup(SITE, GROUP)]
        assert (stored.rollout.state, stored.rollout.ring) == ("running", 0)
        assert {condition.kind for condition in service.conditions(RobotGroup(SITE, GROUP)).values()} == {
            "in force",
            "no bundle",
        }
        healthy = eventually(
            lambda: service.rollouts[RobotGroup(SITE, GROUP)].rollout.healthy, "it is healthy"
        )
        assert healthy > stored.rollout.started + 3000


def test_a_rollout_survives_a_restart_of_postgresql(fleet: Fleet, cluster: PostgresCluster) -> None:
    fleet.add(4)
    path = fleet.publish(*RINGS)
    fleet.poll()
    fleet.start(path, healthy_seconds=2)
    fleet.until(lambda state: state["rings"][0]["in_force"] == 2)
    cluster.kill()
    try:
        assert fleet.operator.post(f"/v1/rollouts/{SITE}/{GROUP}/stop").status_code == 503
        assert _put(fleet, "r-0", in_force=str(path)).status_code == 503
        assert fleet.collector.service.selection("r-0", RobotGroup(SITE, GROUP)) == str(path)
    finally:
        cluster.start()
    fleet.until(lambda state: state["state"] == "done")


def test_a_withdrawn_bundle_stops_its_rollout(fleet: Fleet) -> None:
    fleet.add(4)
    first = fleet.publish(Ring("all", [], 100))
    fleet.poll()
    fleet.start(first)
    fleet.until(lambda state: state["state"] == "done")
    second = fleet.publish(*RINGS, policy_dot_ini="[Nodes]\n")
    fleet.start(second, healthy_seconds=600)
    fleet.until(lambda state: state["rings"][0]["in_force"] == 2)
    fleet.site.repository.withdraw(second)
    state = fleet.until(lambda state: state["state"] == "stopped")
    assert state["why"] == f"{second} was withdrawn"
    fleet.poll()
    assert {robot.poller.progress.trouble for robot in fleet.robots.values()} == {""}


def test_a_bundle_that_is_signed_in_the_future_does_not_start(fleet: Fleet) -> None:
    fleet.add(1)
    terms = everywhere(time.time() + 7200, Ring("all", [], 100))
    path = fleet.site.repository.add(SITE, GROUP, bundle_files(), terms)
    service = fleet.collector.service
    eventually(
        lambda: service.publisher.publication and str(path) in service.publisher.publication.bundles,
        lambda: service.publisher.trouble,
    )
    answer = fleet.operator.post("/v1/rollouts", json={"bundle": str(path)})
    assert answer.status_code == 409
    assert "in the future: correct the clock" in answer.text


def test_the_history_names_the_operators(fleet: Fleet) -> None:
    fleet.add(2)
    first = fleet.publish(Ring("all", [], 100))
    fleet.poll()
    fleet.start(first)
    fleet.until(lambda state: state["state"] == "done")
    second = fleet.publish(*RINGS, policy_dot_ini="[Nodes]\n")
    fleet.start(second, healthy_seconds=600)
    began = time.time()
    service, place = fleet.collector.service, RobotGroup(SITE, GROUP)

    async def both() -> tuple[Any, ...]:
        orders = (service.stop(place, "olga"), service.stop(place, "otto"))
        return await asyncio.gather(*orders, return_exceptions=True)

    fleet.collector.call(both())
    assert fleet.operator.post(f"/v1/rollouts/{SITE}/{GROUP}/revert").status_code == 200
    acts = fleet.operator.get(f"/v1/rollouts/{SITE}/{GROUP}").json()["history"][0]["acts"]
    assert [act["act"] for act in acts] == ["start", "stop", "revert"]
    assert (acts[0]["who"], acts[2]["who"]) == ("operator", "operator")
    assert acts[1]["who"] in ("olga", "otto")
    assert abs(acts[2]["at"] - began) < 60
    with pytest.raises(RolloutRefusedError, match="changed in the meantime"):
        fleet.collector.call(service.revert(place, "olga", number=1))


def test_a_start_and_a_revert_at_the_same_time_exclude_each_other(fleet: Fleet) -> None:
    fleet.add(2)
    paths = [
        fleet.publish(Ring("all", [], 100), policy_dot_ini=f"[Nodes]\n# {number}\n") for number in (1, 2)
    ]
    fleet.poll()
    for path in paths:
        fleet.start(path)
        fleet.until(lambda state: state["state"] == "done")
    store, place = fleet.collector.service.store, RobotGroup(SITE, GROUP)
    before = store.latest()[place]
    rollout = BundleRollout(
        str(paths[0]), str(paths[1]), before.rollout.terms, before.rollout.gates, time.time()
    )
    assert fleet.operator.post(f"/v1/rollouts/{SITE}/{GROUP}/revert").status_code == 200
    assert store.begin(place, before, rollout, time.time()) is None
    now = store.latest()[place]
    assert store.begin(place, now, rollout, time.time()) is not None
    assert not store.replace(place, now, now.rollout, time.time())  # no longer the last one
