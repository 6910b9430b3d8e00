import errno
import functools
import json
import re
import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, Playwright, expect

from examples.landshark.lab import Host as LabHost
from examples.landshark.lab import Lab
from tests.support.appliance import OPEN_POLICY
from tests.support.features.standby.standby_site import ADDRESSES, StandbySite
from tests.support.requirements import need_root
from tests.support.rest import Rest
from tests.support.waiting import eventually
from tests.system.console.conftest import launch
from tests.system.console.reader import LIMIT, Reader

PORT = 8443
SIZES = ((1440, 900), (390, 844))
HOLDER = "10.79.0.20"
POLICY = f"{OPEN_POLICY}[Authority]\nbase = /cmd_vel\ntake base = *\nlease base = 600s\n"
SETTINGS = f"""\
api: 0.0.0.0:{PORT}
api_networks: [10.79.0.0/24]
api_limits: {{requests_per_second: 500, burst: 2000}}
"""


class PairConsoles:
    def __init__(self, site: StandbySite, browser: Browser, tokens: dict[str, str]) -> None:
        self.site = site
        self.browser = browser
        self.tokens = tokens
        self.windows = ExitStack()

    def url(self, name: str) -> str:
        return f"https://{ADDRESSES[name]}:{PORT}"

    def open(self, name: str, role: str, **look: Any) -> Reader:
        return self.windows.enter_context(Reader(self.browser, self.url(name), self.tokens[role], **look))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StandbySite]:
    need_root()
    home = tmp_path_factory.mktemp("pair")
    with Lab("rosrv-console") as lab, StandbySite(lab, home, policy=POLICY, settings=SETTINGS) as site:
        site.start_witness()
        site.start("a")
        site.start("b")
        site.until_both_in_sync()
        yield site


@pytest.fixture(scope="module")
def tokens(site: StandbySite) -> dict[str, str]:
    made = {}
    for role in ("viewer", "operator", "admin"):
        done = site.appliances["a"].rosrv(
            "token", "add", f"some-{role}", "--role", role, "--for", "1d", "--json"
        )
        made[role] = str(json.loads(done.stdout)["token"])
    standby = site.appliances["b"]
    assert isinstance(standby.host, LabHost)
    rest = Rest(f"https://127.0.0.1:{PORT}", made["admin"], standby.state / "api" / "certificate.pem")

    def known() -> bool:
        try:
            return rest.get("/v1/standby").status == 200
        except OSError:  # its certificate is not made yet
            return False

    eventually(functools.partial(standby.host.run, known), "the standby knows the tokens")
    return made


@pytest.fixture(scope="module")
def remote_browser(
    site: StandbySite, chromium: str, playwright: Playwright, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Browser]:
    host = site.lab.host("browser", "10.79.0.30/24")
    program = tmp_path_factory.mktemp("browser") / "chromium"
    program.write_text(f'#!/bin/sh\nexec ip netns exec {host.namespace.name} {chromium} "$@"\n')
    program.chmod(0o755)
    started = launch(playwright, str(program))
    yield started
    started.close()


@pytest.fixture
def pair(site: StandbySite, remote_browser: Browser, tokens: dict[str, str]) -> Iterator[PairConsoles]:
    """Yield the consoles with `a` active: a machine that starved the lease for a second may have made `b` active."""
    if site.holder() != "a":
        site.promote(site.holder())
        site.until_taken_over("a")
        site.until_both_in_sync()
    consoles = PairConsoles(site, remote_browser, tokens)
    with consoles.windows:
        yield consoles


def panel(page: Page) -> Any:
    return page.get_by_role("region", name="Two appliances")


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 390])
def test_both_appliances_are_shown(pair: PairConsoles, theme: str, width: int) -> None:
    reader = pair.open("a", "viewer", theme=theme, width=width)
    page = reader.go("now")
    rows = panel(page).get_by_role("row")
    for row, words in (
        (1, r"^a this one.*10\.79\.0\.2.*active"),
        (2, r"^b.*10\.79\.0\.3.*in sync"),
        (3, "answers"),
    ):
        expect(rows.nth(row)).to_have_text(re.compile(words))
    assert reader.axe() == []
    reader.fits()
    other = pair.open("b", "viewer", theme=theme, width=width)
    other.page.goto(f"{other.url}/console/policy")
    expect(other.page.get_by_role("heading", level=1, name="Standby")).to_be_visible()
    expect(panel(other.page).get_by_role("row").nth(1)).to_have_text(re.compile("^b this one.*standby"))
    link = other.page.get_by_role("link", name="Open the console of a")
    expect(link).to_have_attribute("href", f"{pair.url('a')}/console/now")
    assert other.axe() == []
    other.fits()


def test_a_silent_witness_is_a_banner_on_every_view(pair: PairConsoles) -> None:
    page, other = pair.open("a", "admin").go("graph"), pair.open("b", "viewer").go("now", heading="Standby")
    narrow = pair.open("a", "viewer", width=390, height=844)
    narrow.go("now")
    banner = page.locator(".banner").filter(has_text="the witness on the robot")
    expect(page.locator("[data-standing=live]")).to_be_visible()
    expect(page.locator(".banner")).to_have_count(0)
    assert pair.site.witness is not None
    pair.site.witness.stop()
    expect(banner).to_contain_text("the witness on the robot (10.79.0.10) has not answered")
    narrow.sees(narrow.page.locator(".banner"), "the witness on the robot (10.79.0.10) has not answered")
    page.get_by_role("link", name="Now").click()
    expect(page.get_by_role("region", name="Open alarms")).to_contain_text("systemctl status rosrv-witness")
    expect(panel(page).get_by_role("row").nth(3)).to_contain_text("silent")
    expect(panel(page).get_by_role("row").nth(2)).to_contain_text("cannot take over")
    button = panel(page).get_by_role("button", name="Switch over…")
    expect(button).to_have_attribute("title", re.compile("the witness on the robot .* has not answered"))
    expect(other.locator(".standby .banner")).to_contain_text(
        "the witness on the robot (10.79.0.10) has not answered"
    )
    pair.site.start_witness()
    expect(page.locator(".banner")).to_have_count(0)
    expect(panel(page).get_by_role("row").nth(3)).to_contain_text("answers")
    expect(panel(page).get_by_role("row").nth(2)).to_contain_text("can take over")
    expect(other.locator(".standby .banner")).to_have_count(0)


def test_a_standby_that_could_not_start_is_shown_on_both(pair: PairConsoles) -> None:
    page = pair.open("a", "admin").go("now")
    other = pair.open("b", "viewer").go("now", heading="Standby")
    row, button = (
        panel(page).get_by_role("row").nth(2),
        panel(page).get_by_role("button", name="Switch over…"),
    )
    expect(row).to_contain_text("can take over", timeout=2 * LIMIT)
    reason = re.compile(r"cannot take over.*0\.0\.0\.0:11311 cannot be listened on")
    with eventually(lambda: pair.site.lab.hosts["b"].run(_listener), "the check of b leaves the port"):
        expect(row).to_have_text(reason, timeout=2 * LIMIT)
        expect(page.locator(".banner").filter(has_text="cannot take over")).to_have_text(reason)
        expect(button).to_have_attribute("title", reason)
        expect(panel(other).get_by_role("row").nth(1)).to_have_text(reason, timeout=2 * LIMIT)
    expect(row).to_contain_text("in sync", timeout=2 * LIMIT)
    expect(page.locator(".banner")).to_have_count(0)


def _listener() -> socket.socket | None:
    try:
        return socket.create_server(("0.0.0.0", 11311))
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise
        return None


def test_only_admins_switch_over(pair: PairConsoles) -> None:
    page = pair.open("a", "operator").go("now")
    button = panel(page).get_by_role("button", name="Switch over…")
    expect(button).to_have_attribute("aria-disabled", "true")
    expect(button).to_have_attribute("title", re.compile("For the role admin"))
    button.click(force=True)
    expect(page.get_by_role("dialog")).to_have_count(0)


def test_a_switchover_leads_to_the_other_console_and_back(pair: PairConsoles) -> None:
    """The same token opens the other console. Back on the first page, unsaved work is kept without a reload."""
    reader = pair.open("a", "admin")
    page = reader.go("policy")
    reader.write("# a draft\n")
    page.get_by_role("link", name="Now").click()
    _switch_over(page, "b")
    expect(page.get_by_role("heading", level=1, name="Standby")).to_be_visible(timeout=2 * LIMIT)
    other = pair.open("b", "admin").go("now")
    expect(panel(other).get_by_role("row").nth(1)).to_have_text(re.compile("^b this one.*active"))
    _switch_over(other, "a")
    expect(other.get_by_role("heading", level=1, name="Standby")).to_be_visible(timeout=2 * LIMIT)
    expect(page.get_by_role("heading", level=1, name="Now")).to_be_visible(timeout=2 * LIMIT)
    expect(page.locator("[data-standing=live]")).to_be_visible(timeout=2 * LIMIT)
    page.get_by_role("link", name="Policy", exact=True).click()
    expect(reader.editor()).to_contain_text("# a draft")
    active = pair.site.appliances["a"]
    ordered, failed = (active.audit("--event", f"switchover {word}") for word in ("ordered", "failed"))
    assert len(ordered) == 1 + len(failed)
    assert {record["detail"]["who"] for record in ordered} == {"some-admin"}


def _switch_over(page: Page, name: str) -> None:
    button = panel(page).get_by_role("button", name="Switch over…")
    expect(button).not_to_have_attribute("aria-disabled", "true", timeout=2 * LIMIT)
    button.click()
    dialog = page.get_by_role("dialog", name=f"Switch over to {name}?")
    order = dialog.get_by_role("button", name="Switch over", exact=True)
    late = dialog.get_by_role("alert").filter(has_text="has not stored the last changes")

    def closed() -> bool:
        if late.is_visible():
            order.click()
            expect(late).to_have_count(0)
        return dialog.count() == 0

    order.click()
    eventually(closed, "the switchover is ordered")


def test_a_standby_that_died_is_seen_at_once(pair: PairConsoles) -> None:
    windows = [pair.open("a", "viewer", width=width, height=height) for width, height in SIZES]
    for reader in windows:
        reader.go("now")
        expect(panel(reader.page).get_by_role("row").nth(2)).to_contain_text(
            "can take over", timeout=2 * LIMIT
        )
    pair.site.signal("b", signal.SIGKILL)
    for reader in windows:
        reader.sees(ready(reader.page), re.compile(r"b is away for \d+ s"))
        reader.fits()
        reader.keep_picture("a_dead_standby")
        expect(panel(reader.page).get_by_role("row").nth(2)).to_contain_text("away")
    one = pair.site.appliances["b"]
    assert one.process is not None
    one.process.stop()
    pair.site.start("b")
    pair.site.until_both_in_sync()
    for reader in windows:
        expect(ready(reader.page)).to_contain_text("b can take over", timeout=2 * LIMIT)


def test_a_page_of_the_earlier_active_shows_no_holder_as_present(pair: PairConsoles) -> None:
    """Its machine loses its power: the page says so. The new active has no holder, and the page then leads there."""
    pair.site.appliances["a"].rosrv("drive", "assign", "base", "--host", HOLDER)
    windows = [pair.open("a", "admin", width=width, height=height) for width, height in SIZES]
    for reader in windows:
        expect(drives(reader.go("now"))).to_contain_text(f"{HOLDER} drives base")
    pair.site.cut("a")
    for reader in windows:
        reader.sees(reader.page.locator(".banner"), re.compile("No news|Not live"))
        reader.sees(drives(reader.page), re.compile(r"^Drives, \d+ s ago"))
        reader.fits()
        reader.keep_picture("the_active_died")
    pair.site.until_taken_over("b")
    for width, height in SIZES:
        reader = pair.open("b", "admin", width=width, height=height)
        reader.go("now")
        reader.sees(drives(reader.page), "no host drives base")
        reader.sees(ready(reader.page), re.compile("a (is away|cannot take over)"))
        reader.keep_picture("after_a_takeover")
    pair.site.restore("a")
    for reader in windows:
        expect(reader.page.get_by_role("heading", level=1, name="Standby")).to_be_visible(timeout=2 * LIMIT)
        expect(reader.page.get_by_role("link", name="Open the console of b")).to_be_visible()
        expect(reader.page.get_by_text(HOLDER)).to_be_hidden()
        reader.keep_picture("the_earlier_active_is_the_standby")


def drives(page: Page) -> Any:
    return page.get_by_role("region", name="Situation").get_by_role("link", name=re.compile("^Drives"))


def ready(page: Page) -> Any:
    return page.get_by_role("region", name="Situation").get_by_role("link", name=re.compile("^Standby"))
