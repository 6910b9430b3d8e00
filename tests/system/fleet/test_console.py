"""The collector's console in a real browser: log in, robots, search; no script, no text of a robot as markup."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, ConsoleMessage, Page, sync_playwright

from tests.support.requirements import need_program
from tests.system.fleet.fleet_site import FleetRobot, FleetSite

MakeRobot = Callable[..., FleetRobot]
_MARKUP = "<script>document.title='owned'</script><b id=owned>"


@contextmanager
def opened_page() -> Iterator[Page]:
    """Return a page of headless Chromium; an error in its console fails the test."""
    program = need_program("chromium", "chromium")
    with sync_playwright() as playwright:
        browser: Browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        opened = browser.new_page(ignore_https_errors=True, viewport={"width": 1280, "height": 800})
        said: list[str] = []

        def hear(message: ConsoleMessage) -> None:
            if message.type in ("error", "warning"):
                said.append(message.text)

        opened.on("console", hear)
        yield opened
        browser.close()
        assert said == []


def test_the_console(site: FleetSite, make_robot: MakeRobot) -> None:
    """An operator logs in, sees the robots and a gap, and finds a record; texts of robots stay texts."""
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
    assert page.get_by_role("row", name="arm1").get_by_role("cell").first.inner_text() == "complete"
    assert "never" in page.get_by_role("row", name="arm2").inner_text()
    page.get_by_label("text", exact=True).fill("owned")
    page.get_by_role("button", name="Search").click()
    records = page.get_by_role("table", name="Records").get_by_role("row")
    assert records.count() == 11
    assert _MARKUP in records.nth(1).inner_text()
    assert "\\u202e" in records.nth(1).inner_text()
    assert page.locator("#owned").count() == 0
    assert "ROSRV fleet" in page.title()
    page.screenshot(path=site.folder / "console.png", full_page=True)
    page.get_by_label("since").fill("soon")
    page.get_by_role("button", name="Search").click()
    assert page.get_by_text("'soon' is not a valid time").is_visible()
    page.get_by_role("button", name="Log out").click()
    page.wait_for_url("**/login")
    page.goto(f"https://127.0.0.1:{site.port}/")
    page.wait_for_url("**/login")


def test_a_wrong_token_is_refused(site: FleetSite) -> None:
    """The form refuses an unknown token; the page forbids scripts, frames and other origins."""
    with site.client() as client:
        answer = client.post("/login", data={"token": "wrong"})
        assert answer.status_code == 401
        assert "set-cookie" not in answer.headers
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert client.post("/login", content=b"x" * 5000).status_code == 413
        given = client.post("/login", data={"token": site.token})
        cookie = given.headers["set-cookie"].lower()
        assert all(word in cookie for word in ("httponly", "secure", "samesite=strict", "__host-"))
