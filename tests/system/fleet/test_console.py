import datetime
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import httpx
import msgspec
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, ConsoleMessage, Page, expect, sync_playwright
from rosrv_fleet.enrolment import Robot

from fleet.tests.support.fleet_site import FleetRobot, FleetSite
from tests.support.certificates import self_signed
from tests.support.processes import LIMIT
from tests.support.requirements import need_program
from tests.support.waiting import eventually
from tests.system.fleet.incidents import incident
from tests.system.fleet.test_bundles import BUNDLE, Operator, serve_bundles

PLACE = "site-a/arms"
MakeRobot = Callable[..., FleetRobot]
_LIMIT = 1000 * LIMIT  # milliseconds to wait for an answer
expect.set_options(timeout=_LIMIT)
_MARKUP = "<script>document.title='owned'</script><b id=owned>"


@contextmanager
def opened_page(width: int = 1280, theme: Literal["light", "dark"] = "light") -> Iterator[Page]:
    program = need_program("chromium", "chromium")
    with sync_playwright() as playwright:
        browser: Browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        opened = browser.new_page(
            ignore_https_errors=True, viewport={"width": width, "height": 800}, color_scheme=theme
        )
        opened.set_default_timeout(_LIMIT)
        said: list[str] = []

        def hear(message: ConsoleMessage) -> None:
            # The browser reports pages with an error status itself.
            if message.type in ("error", "warning") and "Failed to load resource" not in message.text:
                said.append(message.text)

        opened.on("console", hear)
        yield opened
        browser.close()
        assert said == []


def log_in(page: Page, site: FleetSite, token: str) -> None:
    page.goto(f"https://127.0.0.1:{site.port}/login")
    expect(page.get_by_label("Token")).to_be_focused()
    page.keyboard.type(token)
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="Robots", exact=True).wait_for()


def test_the_console(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(10, reason=_MARKUP, caller_id="/x\u202e")
    robot.record(5)
    robot.push()
    make_robot("arm2")
    site.indexed()
    with opened_page() as page:
        _look_around(site, page)


def _look_around(site: FleetSite, page: Page) -> None:
    page.goto(f"https://127.0.0.1:{site.port}/")
    page.wait_for_url("**/login")
    page.get_by_label("Token").fill(site.token)
    page.get_by_role("button", name="Log in").click()
    expect(page.get_by_role("row", name="arm1").get_by_role("cell").nth(1)).to_have_text("complete")
    expect(page.get_by_role("row", name="arm2")).to_contain_text("never")
    page.get_by_role("link", name="Search").click()
    page.get_by_label("text", exact=True).fill("owned")
    page.get_by_role("button", name="Search").click()
    records = page.get_by_role("table", name="Records").get_by_role("row")
    expect(records).to_have_count(11)
    assert _MARKUP in records.nth(1).inner_text()
    assert "\\u202e" in records.nth(1).inner_text()
    assert page.locator("#owned").count() == 0
    assert "ROSRV fleet" in page.title()
    page.screenshot(path=site.folder / "console.png", full_page=True)
    page.get_by_label("since").fill("soon")
    page.get_by_role("button", name="Search").click()
    expect(page.get_by_text("'soon' is not a valid time")).to_be_visible()
    page.get_by_role("button", name="Log out").click()
    page.wait_for_url("**/login")
    page.goto(f"https://127.0.0.1:{site.port}/")
    page.wait_for_url("**/login")


def test_a_wrong_token_is_refused(site: FleetSite) -> None:
    with site.client() as client:
        answer = client.post("/login", data={"token": "wrong"})
        assert answer.status_code == 401
        assert "set-cookie" not in answer.headers
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert client.post("/login", content=b"x" * 5000).status_code == 413
        given = client.post("/login", data={"token": site.token})
        cookie = given.headers["set-cookie"].lower()
        assert all(word in cookie for word in ("httponly", "secure", "samesite=strict", "__host-"))


class RolloutSite:
    def __init__(self, site: FleetSite, folder: Path, make_robot: MakeRobot) -> None:
        self.site = site
        self.operator = Operator(site, folder / "operator")
        serve_bundles(site, self.operator)
        self.robots = [make_robot(f"arm{number}", group=PLACE) for number in range(3)]
        self.report()
        self.start()
        self.report(in_force=BUNDLE)

    @property
    def token(self) -> str:
        return self.operator.token.read_text().strip()

    def start(self) -> None:
        wanted = {"bundle": BUNDLE, "gates": {"healthy_seconds": 600, "silent_seconds": 3600}}
        with self.site.client() as client:
            header = {"Authorization": f"Bearer {self.token}"}
            answer = client.post("/v1/rollouts", json=wanted, headers=header)
            assert answer.status_code == 200, answer.text

    def report(self, **changes: Any) -> None:
        report: dict[str, Any] = dict.fromkeys(("in_force", "trying", "refused", "reason", "trouble"), "")
        report |= {"site": "site-a", "group": "arms", "changed": False, "denials": 0, "failing": 0} | changes
        for robot in self.robots[:-1]:
            with self.site.client(robot.certificates) as client:
                assert client.put("/v1/bundles/report", json=report).status_code == 204

    def order(self, token: str, number: str, **headers: str) -> httpx.Response:
        cookie = {"Cookie": f"__Host-rosrv-fleet={token}"}
        with self.site.client() as client:
            return client.post(f"/rollouts/{PLACE}/stop", data={"number": number}, headers=cookie | headers)

    def rollout(self) -> dict[str, Any]:
        return dict(self.site.get(f"/v1/rollouts/{PLACE}").json()["rollout"])


@pytest.fixture
def rollouts(site: FleetSite, tmp_path: Path, make_robot: MakeRobot) -> RolloutSite:
    return RolloutSite(site, tmp_path, make_robot)


def _follow(page: Page, name: str) -> None:
    focused = "document.activeElement.textContent.trim()"
    for _ in range(60):
        if page.evaluate(focused) == name:
            with page.expect_navigation():
                page.keyboard.press("Enter")
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"{name} cannot be reached with the keyboard")


def test_an_operator_stops_a_rollout_with_the_keyboard(rollouts: RolloutSite) -> None:
    with opened_page() as page:
        log_in(page, rollouts.site, rollouts.token)
        for name in ("Rollouts", PLACE, "Stop…"):
            _follow(page, name)
        assert rollouts.rollout()["state"] == "running"
        expect(page.get_by_text("No further robot gets this bundle")).to_be_visible()
        _follow(page, "Stop the rollout")
        expect(page.get_by_role("table", name="History")).to_contain_text("stop by olga")
        expect(page.locator("main")).to_contain_text("stopped by olga")
        robots = page.get_by_role("table", name="Robots").get_by_role("row")
        expect(robots.nth(1)).to_contain_text("never seen")  # the problem is first
        assert page.get_by_role("link", name="Stop…").count() == 0
    assert rollouts.rollout()["state"] == "stopped"


def test_only_an_operator_on_this_site_stops_a_rollout(rollouts: RolloutSite) -> None:
    viewer = rollouts.site.token
    own = f"https://127.0.0.1:{rollouts.site.port}"
    with opened_page() as page:
        log_in(page, rollouts.site, viewer)
        page.goto(f"{own}/rollouts/{PLACE}")
        expect(page.get_by_role("table", name="Rings")).to_be_visible()
        assert page.get_by_role("link", name="Stop…").count() == 0
        answer = page.goto(f"{own}/rollouts/{PLACE}/stop")
        assert answer is not None
        assert answer.status == 403
    number = str(rollouts.rollout()["number"])
    assert rollouts.order(viewer, number, Origin=own).status_code == 403
    for origin in ("https://elsewhere.example", "null", own.replace("https", "http")):
        assert rollouts.order(rollouts.token, number, Origin=origin).status_code == 403
    assert rollouts.order("unknown", number).headers["location"] == "/login"
    for wrong in ("", "x", "999"):
        assert rollouts.order(rollouts.token, wrong).status_code == 409
    assert rollouts.rollout()["state"] == "running"
    assert rollouts.order(rollouts.token, number, Origin=own).status_code == 303
    assert rollouts.rollout()["state"] == "stopped"


_VIEWS: tuple[tuple[Literal["light", "dark"], int], ...] = (("light", 1280), ("dark", 640), ("light", 320))
PAGES = {
    "robots": "/",
    "nothing found": "/?name=unknown",
    "rollouts": "/rollouts",
    "one rollout": f"/rollouts/{PLACE}",
    "stop": f"/rollouts/{PLACE}/stop",
    "an unknown group": "/rollouts/site-a/legs",
    "search": "/search",
    "records": "/search?robot=arm0",
    "no record": "/search?text=unknown",
    "a wrong time": "/search?since=soon",
    "evidence": "/evidence",
    "no evidence": "/evidence?robot=unknown",
}


def test_axe_finds_nothing(rollouts: RolloutSite) -> None:
    robot = rollouts.robots[0]
    robot.record(
        10, reason="no rule of the policy names 10.0.0.5, which registers /a_publisher_with_a_long_name"
    )
    robot.push()
    bundle = str(incident(robot, rollouts.site.folder / "incident.zip"))
    rollouts.operator.remote("evidence", "add", bundle, "--robot", robot.name)
    rollouts.site.indexed()
    found: dict[str, object] = {}
    for theme, width in _VIEWS:
        with opened_page(width, theme) as page:
            found |= {f"{name}, {theme}, {width}": wrong for name, wrong in _violations(page, rollouts)}
    assert {name: violations for name, violations in found.items() if violations} == {}


def _violations(page: Page, rollouts: RolloutSite) -> Iterator[tuple[str, list[str]]]:
    page.goto(f"https://127.0.0.1:{rollouts.site.port}/login")
    yield "login", _axe(page)
    page.get_by_label("Token").fill("wrong")
    page.keyboard.press("Enter")
    page.get_by_text("This token is unknown").wait_for()
    yield "a wrong token", _axe(page)
    log_in(page, rollouts.site, rollouts.token)
    for name, path in PAGES.items():
        page.goto(f"https://127.0.0.1:{rollouts.site.port}{path}")
        too_wide = page.evaluate("document.documentElement.scrollWidth > innerWidth")
        yield name, _axe(page) + ["it is wider than the window"] * too_wide


def _axe(page: Page) -> list[str]:
    kinds = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
    found = Axe().run(page, options={"resultTypes": ["violations"], "runOnly": kinds})
    return [
        f"{violation['id']}: {[node['target'] for node in violation['nodes'][:3]]}"
        for violation in found.response["violations"]
    ]


def test_hundreds_of_robots_are_usable(site: FleetSite) -> None:
    assert site.data is not None
    certificate, now = site.server.certificate.read_text(), time.time_ns()
    today = datetime.datetime.now(datetime.UTC)
    ending = site.folder / "ending.pem"
    self_signed(ending, "127.0.0.1", today, today + datetime.timedelta(days=2))
    for number in range(250):
        used = ending.read_text() if number == 200 else certificate
        robot = Robot(
            name=f"arm{number:03}", key=f"{number:064x}", certificate=used, added=now,
            group=f"site-{number % 2}/arms",
        )  # fmt: skip
        (site.data / "robots" / f"{robot.name}.json").write_bytes(msgspec.json.encode(robot))
    eventually(lambda: len(site.health()["robots"]) == 250, "the collector notices the robots")
    with opened_page() as page:
        log_in(page, site, site.token)
        rows = page.get_by_role("table", name="Robots").get_by_role("row")
        expect(rows).to_have_count(101)
        assert "arm200" in rows.nth(1).inner_text()
        assert "arm000" in rows.nth(2).inner_text()
        page.get_by_role("link", name="Next").click()
        page.get_by_role("link", name="Next").click()
        expect(page.get_by_text("201 to 250 of 250")).to_be_visible()
        page.get_by_role("link", name="1 with problems").click()
        expect(rows).to_have_count(2)
        page.get_by_label("state").select_option("")
        page.get_by_label("name").fill("M04")
        page.get_by_label("group").select_option("site-1/arms")
        page.get_by_role("button", name="Show").click()
        expect(rows.get_by_role("rowheader")).to_have_text(["arm041", "arm043", "arm045", "arm047", "arm049"])
