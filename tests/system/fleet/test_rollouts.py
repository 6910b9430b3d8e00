"""Rollouts with robots that use the real client, a real collector and PostgreSQL."""

import json
import shutil
import ssl
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from rosrv_fleet.rollouts.console_section import rollouts_section
from rosrv_fleet.rollouts.store import Group

from appliance.bundles.collector_connection import robot_context
from appliance.bundles.poller import Poller
from appliance.bundles.terms import BundlePath, Ring
from appliance.channel.messages import BundleHealth, BundleOffered, BundleStated, RefusedBundle
from tests.support.bundle_site import GROUP, SITE, BundleSite, bundle_files, everywhere
from tests.support.rollout_collector import RolloutCollector, collector
from tests.support.waiting import eventually

QUICK = {"healthy_seconds": 0, "share": 0.9}
RINGS = (Ring("canary", ["r-0", "r-1"]), Ring("half", [], 50), Ring("rest", [], 100))


@dataclass
class Robot:
    """A robot with the real poller; instead of control it has a function that judges bundles."""

    name: str
    poller: Poller
    judge: Callable[[BundleOffered], str]
    stated: BundleStated = field(default_factory=BundleStated)
    taken: list[str] = field(default_factory=list)

    def offered(self, bundle: BundleOffered) -> None:
        """Judge a bundle, as control does: take it, or refuse it with a reason."""
        reason = self.judge(bundle)
        if reason:
            refused = RefusedBundle(bundle.path, bundle.sha256, reason)
            self.stated = BundleStated(self.stated.in_force, self.stated.sha256, refused=refused)
        else:
            self.taken.append(bundle.path)
            self.stated = BundleStated(bundle.path, bundle.sha256, health=self.stated.health)

    def deny(self, denials: int) -> None:
        """Set the number of denials in the last minute."""
        self.stated = BundleStated(self.stated.in_force, self.stated.sha256, health=BundleHealth(denials))


class Fleet:
    """A site, its collector and robots; `poll` lets all robots poll once, several at a time."""

    def __init__(self, site: BundleSite, running: RolloutCollector, folder: Path) -> None:
        self.site, self.collector, self.folder = site, running, folder
        self.robots: dict[str, Robot] = {}
        certificate, key = site.authority.issue("operator")
        self.operator = httpx.Client(
            base_url=running.url, verify=_context(site, certificate, key), timeout=30, trust_env=False
        )

    def add(self, count: int) -> None:
        """Add robots."""
        for _ in range(count):
            name = f"r-{len(self.robots)}"
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
        """Let robots poll once."""
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
        """Sign and publish a bundle."""
        return self.site.repository.add(SITE, GROUP, bundle_files(**files), everywhere(None, *rings))

    def start(self, path: BundlePath, **gates: Any) -> dict[str, Any]:
        """Begin a rollout as an operator does."""

        def there() -> bool:
            publication = self.collector.service.publication
            return publication is not None and str(path) in publication.bundles

        eventually(there, f"{path} is published: {self.collector.service.trouble}")
        answer = self.operator.post("/v1/rollouts", json={"bundle": str(path), "gates": QUICK | gates})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    def state(self) -> dict[str, Any]:
        """Return the rollout of the group."""
        return dict(self.operator.get(f"/v1/rollouts/{SITE}/{GROUP}").json()["rollout"])

    def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Let all robots poll until the rollout is as wanted."""

        def found() -> dict[str, Any] | None:
            self.poll()
            state = self.state()
            return state if wanted(state) else None

        return eventually(found, lambda: json.dumps(self.state()))


def _nameless(fleet: Fleet) -> httpx.Client:
    """Return a client without a certificate."""
    return httpx.Client(verify=ssl.create_default_context(cafile=fleet.site.authority.ca), trust_env=False)


def _context(site: BundleSite, certificate: Path, key: Path) -> Any:
    return robot_context(site.authority.ca, certificate, key)


@pytest.fixture
def fleet(tmp_path: Path, database: str) -> Iterator[Fleet]:
    """Run a site and its collector."""
    site = BundleSite(tmp_path / "site")
    with collector(site.repository.folder, site.authority, database) as running:
        made = Fleet(site, running, tmp_path)
        try:
            yield made
        finally:
            made.operator.close()
            for opened in site.connections:
                opened.close()


def test_a_rollout_reaches_all_robots_ring_by_ring(fleet: Fleet) -> None:
    """With 54 robots: the canaries get the bundle first, then half of the robots, then all."""
    fleet.add(54)
    path = fleet.publish(*RINGS)
    eventually(lambda: fleet.collector.service.timestamp is not None, "a timestamp")
    fleet.poll()
    fleet.start(path)
    fleet.poll(*list(fleet.robots)[2:])
    assert not any(robot.taken for robot in fleet.robots.values())
    state = fleet.until(lambda state: state["state"] == "done")
    assert [ring["in_force"] for ring in state["rings"]] == [ring["robots"] for ring in state["rings"]]
    assert all(robot.taken == [str(path)] for robot in fleet.robots.values())


def test_a_bad_canary_stops_the_rollout(fleet: Fleet) -> None:
    """If the canaries refuse the bundle, the rollout stops automatically, and no other robot ever gets it."""
    fleet.add(52)
    fleet.robots["r-0"].judge = lambda _bundle: "policy.ini:3:1: error: <script>"
    path = fleet.publish(*RINGS)
    eventually(lambda: fleet.collector.service.timestamp is not None, "a timestamp")
    fleet.poll()
    fleet.start(path)
    state = fleet.until(lambda state: state["state"] == "stopped")
    assert "refused: policy.ini:3:1" in state["why"]
    section = rollouts_section(fleet.collector.service)
    assert '<td class="bad">stopped: ' in section
    assert "<script>" not in section
    fleet.poll()
    assert {name for name, robot in fleet.robots.items() if robot.taken} <= {"r-1"}


def test_denials_three_times_as_frequent_stop_the_rollout(fleet: Fleet) -> None:
    """Canaries whose denials multiply under the new bundle stop the rollout; revert brings the former bundle back."""
    fleet.add(8)
    first = fleet.publish(Ring("all", [], 100))
    eventually(lambda: fleet.collector.service.timestamp is not None, "a timestamp")
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
    """A report has the name of the certificate, a robot is not an operator, and clients without one get no answer."""
    fleet.add(1)
    fleet.poll()
    assert set(fleet.collector.service.robots[Group(SITE, GROUP)]) == {"r-0"}
    certificate, key = fleet.site.authority.issue("r-0")
    with httpx.Client(verify=_context(fleet.site, certificate, key), trust_env=False) as robot:
        assert robot.get(f"{fleet.collector.url}/v1/rollouts").status_code == 403
        assert robot.post(f"{fleet.collector.url}/v1/rollouts/{SITE}/{GROUP}/stop").status_code == 403
    with pytest.raises(httpx.HTTPError), _nameless(fleet) as nameless:
        nameless.get(f"{fleet.collector.url}/v1/bundles/metadata/timestamp.json")


def test_an_event_wakes_the_robot(fleet: Fleet) -> None:
    """The collector sends an event to a robot whose selection changes."""
    fleet.add(1)
    path = fleet.publish(Ring("all", [], 100))
    eventually(lambda: fleet.collector.service.timestamp is not None, "a timestamp")
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


def test_half_of_a_publication_is_not_served(fleet: Fleet) -> None:
    """While the files of a snapshot are missing or damaged, the collector signs no timestamp for it and says why."""
    service = fleet.collector.service
    fleet.publish(Ring("all", [], 100))
    eventually(lambda: service.timestamp is not None and not service.trouble, "a timestamp")
    before = service.timestamp
    hidden = fleet.folder / "hidden"
    fleet.publish(Ring("all", [], 100), policy_dot_ini="[Nodes]\n# other\n")
    archive = max(
        (fleet.site.repository.targets / SITE / GROUP).iterdir(), key=lambda path: path.stat().st_mtime_ns
    )
    shutil.move(archive, hidden)
    fleet.site.repository.sign()
    eventually(lambda: "publish it again" in service.trouble, lambda: service.trouble)
    shutil.move(hidden, archive)
    eventually(lambda: not service.trouble and service.timestamp != before, lambda: service.trouble)
