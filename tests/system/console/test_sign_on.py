"""Sign on at canaille, an independent provider with its own authority."""

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.canaille import CLIENT, ISSUER, NAME, PORT, SECRET, Canaille, sign_in
from tests.support.certificates import make_certificates
from tests.support.waiting import eventually
from tests.system.console.conftest import launch

APPLIANCE, PROVIDER = "10.77.0.2", "10.77.0.5"
URL = f"https://{APPLIANCE}:8443"
POLICY = """
[Groups]
site = 10.77.0.0/24 door:floor
[Nodes]
default = site
[Publishers]
default = site
[Subscribers]
default = site
[Commands]
default = site
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("provider")


@pytest.fixture(scope="module")
def provider(common_lab: Lab, folder: Path) -> Canaille:
    host = common_lab.host("provider", f"{PROVIDER}/24")
    canaille = Canaille(host, folder, make_certificates(folder / "tls"), f"{URL}/console")
    canaille.add({"crew": ["alice"], "strangers": ["mallory"]})
    return canaille


@pytest.fixture(scope="module")
def appliance(common_lab: Lab, provider: Canaille, folder: Path) -> Iterator[Appliance]:
    (folder / "secret").write_text(f"{SECRET}\n")
    settings = f"""
api_networks: [10.77.0.0/24]
sso:
  issuer: {ISSUER}
  address: {PROVIDER}:{PORT}
  ca: {folder}/tls/ca.pem
  client_id: {CLIENT}
  client_secret_file: {folder}/secret
  url: {URL}
  scopes: [openid, profile, groups]
  name_claim: preferred_username
  roles: {{operator: [crew], viewer: [staff]}}
  doors: {{floor: [crew]}}
"""
    host = common_lab.host("appliance", f"{APPLIANCE}/24")
    with Appliance(host, policy=POLICY, settings=settings, options=("--api", f"{APPLIANCE}:8443")) as running:
        running.rosrv("door", "add", "floor")
        yield running


@pytest.fixture(scope="module")
def browser(common_lab: Lab, chromium: str) -> Iterator[Browser]:
    desk: Host = common_lab.host("desk", "10.77.0.20/24")
    with ExitStack() as stack:
        with desk.entered():
            playwright = stack.enter_context(sync_playwright())
        started = launch(playwright, chromium, f"--host-resolver-rules=MAP {NAME} {PROVIDER}")
        stack.callback(started.close)
        yield started


@pytest.fixture
def signed_in(appliance: Appliance, browser: Browser) -> Iterator[Callable[[str], Page]]:
    with ExitStack() as stack:

        def open_window(person: str) -> Page:
            context = browser.new_context(ignore_https_errors=True)  # both certificates are of the test
            stack.callback(context.close)
            page = context.new_page()
            page.goto(f"{URL}/console")
            page.get_by_role("button", name="Sign in with").click()
            sign_in(page, person)
            return page

        yield open_window


def test_a_group_of_the_provider_opens_console_and_door_until_it_is_taken_away(
    provider: Canaille, appliance: Appliance, signed_in: Callable[[str], Page]
) -> None:
    with provider.running():
        page = signed_in("alice")
        expect(page.locator(".who-name")).to_have_text("sso:alice")
        expect(page.locator("[data-role]")).to_have_text("operator")
        page.get_by_role("link", name=re.compile("^Robot")).click()
        page.get_by_role("region", name="Your door").get_by_role("button", name="Open").click()
        [client] = eventually(lambda: appliance.row("door", "list")["clients"], appliance.story)
        assert client["who"] == "sso:alice"
        refused = signed_in("mallory")
        expect(
            refused.get_by_text("mallory has no role here: the claim groups has strangers")
        ).to_be_visible()
    provider.rename_group("crew", "staff")
    expect(page.locator("[data-role]")).to_have_text("operator")  # until the next sign-on
    with provider.running():
        again = signed_in("alice")
        expect(again.locator("[data-role]")).to_have_text("viewer")
        expect(page.get_by_text("The session has ended. Sign in again.")).to_be_visible()
        eventually(lambda: not appliance.row("door", "list")["clients"], appliance.story)


def _sign_out(page: Page) -> None:
    page.get_by_role("button", name="Sign out").click()


def _leave_until_it_is_locked(page: Page) -> None:
    page.clock.install()
    page.reload()
    expect(page.locator(".who-name")).to_be_visible()
    page.clock.fast_forward("15:10")
    expect(page.get_by_role("status").filter(has_text="Locked")).to_be_visible()


def _leave_and_reload(page: Page) -> None:
    page.evaluate("sessionStorage.setItem('rosrv.used', String(Date.now() - 16 * 60000))")
    page.reload()
    expect(page.get_by_label("Access token")).to_be_visible()


@pytest.mark.parametrize("new_tab", [False, True], ids=["same tab", "new tab"])
@pytest.mark.parametrize(
    "leave", [_sign_out, _leave_until_it_is_locked, _leave_and_reload], ids=["out", "locked", "reloaded"]
)
@pytest.mark.usefixtures("appliance")
def test_the_provider_asks_who_signs_in_once_a_person_has_left(
    leave: Callable[[Page], None],
    new_tab: bool,
    provider: Canaille,
    signed_in: Callable[[str], Page],
) -> None:
    with provider.running():
        page = signed_in("alice")
        expect(page.locator(".who-name")).to_have_text("sso:alice")
        leave(page)
        if new_tab:
            page = page.context.new_page()
            page.goto(f"{URL}/console")
        page.get_by_role("button", name="Sign in with").click()
        sign_in(page, "alice")  # fails without a question
        expect(page.locator(".who-name")).to_have_text("sso:alice")
        other = page.context.new_page()
        other.goto(f"{URL}/console")
        other.get_by_role("button", name="Sign in with").click()
        expect(other.locator(".who-name")).to_have_text("sso:alice")  # without a question: alice is here
