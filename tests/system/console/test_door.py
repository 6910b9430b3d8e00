from collections.abc import Callable

from playwright.sync_api import Browser, Route, expect

from tests.support.appliance import Appliance
from tests.system.console.reader import Reader


def test_a_wrong_token_stays_outside_and_a_right_one_shows_its_role(
    browser: Browser, appliance: Appliance, token: Callable[..., str]
) -> None:
    with Reader(browser, str(appliance.ready["api"])) as reader:
        page = reader.page
        page.goto(reader.url)
        page.get_by_label("Access token").fill("rosrv_000000000000_nothing")
        page.get_by_role("button", name="Sign in").click()
        expect(page.get_by_role("alert")).to_contain_text("wrong or revoked")
        page.get_by_label("Access token").fill(token("viewer", "reader-1"))
        page.get_by_role("button", name="Sign in").click()
        expect(page.get_by_role("heading", level=1, name="Now")).to_be_visible()
        expect(page.locator("[data-role]")).to_have_text("viewer")
        expect(page.locator(".who-name")).to_have_text("reader-1")
        assert "rosrv_" not in page.url


def test_the_token_is_forgotten(browser: Browser, appliance: Appliance) -> None:
    with Reader(browser, str(appliance.ready["api"])) as reader:
        page = reader.page
        for keep in (False, True):
            page.goto(f"{reader.url}/console/audit")
            page.get_by_label("Access token").fill(str(appliance.ready["token"]))
            page.get_by_label("Stay signed in").set_checked(keep)
            page.get_by_role("button", name="Sign in").click()
            expect(page.get_by_role("heading", level=1, name="Audit")).to_be_visible()
            page.reload()
            expected = (
                page.get_by_role("heading", level=1, name="Audit")
                if keep
                else page.get_by_label("Access token")
            )
            expect(expected).to_be_visible()
        page.get_by_role("button", name="Sign out").click()
        expect(page.get_by_label("Access token")).to_be_visible()
        assert (
            page.evaluate("[...Object.values(sessionStorage), ...Object.values(localStorage)].join()") == ""
        )


def test_a_revoked_token_ends_the_session_at_once(
    appliance: Appliance, token: Callable[..., str], opened: Callable[..., Reader]
) -> None:
    reader = opened(token("operator", "leaver"))
    reader.go("now")
    expect(reader.page.locator("[data-standing=live]")).to_be_visible()
    appliance.rosrv("token", "revoke", "leaver")
    expect(reader.page.get_by_label("Access token")).to_be_visible()
    expect(reader.page.get_by_role("status").filter(has_text="Signed out")).to_contain_text("revoked")
    assert reader.page.evaluate("sessionStorage.getItem('rosrv.token')") is None


def test_an_expired_token_ends_the_session(token: Callable[..., str], opened: Callable[..., Reader]) -> None:
    reader = opened(token("viewer", "short", "12h"))
    reader.page.clock.install()
    reader.go("now")
    expect(reader.page.locator("[data-standing=live]")).to_be_visible()
    reader.page.clock.fast_forward("13:00:00")
    expect(reader.page.get_by_label("Access token")).to_be_visible()
    expect(reader.page.get_by_role("status").filter(has_text="Signed out")).to_contain_text("rosrv token add")


def test_an_unused_page_is_locked_and_loses_nothing(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    reader = opened()
    reader.page.clock.install()
    page = reader.go("policy")
    reader.write("[Nodes]\n# not finished")
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_role("dialog").get_by_label("Comment").fill("ticket 812")
    page.clock.fast_forward("14:00")
    page.mouse.move(10, 10)
    page.clock.fast_forward("14:00")
    expect(page.get_by_label("Comment")).to_be_visible()
    page.clock.fast_forward("15:00")
    expect(page.get_by_role("status").filter(has_text="Locked")).to_contain_text("The work of first is kept")
    expect(page.get_by_label("Comment")).to_be_hidden()
    expect(reader.editor()).to_be_hidden()
    assert page.evaluate("sessionStorage.getItem('rosrv.token')") is None
    assert reader.axe() == []
    before = len(reader.asked)
    for key in ("Escape", "Escape", "4"):
        page.keyboard.press(key)
    page.clock.fast_forward("10:00")
    expect(page.get_by_label("Access token")).to_be_visible()
    assert reader.asked[before:] == []
    page.get_by_label("Access token").fill(str(appliance.ready["token"]))
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_label("Comment")).to_have_value("ticket 812")
    page.keyboard.press("Escape")
    expect(reader.editor()).to_contain_text("# not finished")
    expect(page.locator("[data-standing=live]")).to_be_visible()


def test_a_stored_token_waits_for_the_appliance(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    reader = opened()
    answers: list[Callable[[Route], None]] = [
        lambda route: route.fulfill(
            status=503, content_type="application/problem+json", json={"detail": "the appliance is starting"}
        ),
        lambda route: route.abort(),
        lambda route: route.continue_(),
    ]
    page = reader.page

    def answer(route: Route) -> None:
        answers[0](route)

    page.route("**/v1/whoami", answer)
    page.goto(f"{reader.url}/console/audit")
    waiting = page.get_by_role("region", name="Waiting")
    expect(waiting.get_by_role("alert")).to_contain_text("the appliance is starting")
    expect(waiting.get_by_role("status")).to_contain_text("tries again automatically")
    answers.pop(0)
    expect(waiting.get_by_role("alert")).to_contain_text("The appliance does not answer")
    answers.pop(0)
    expect(page.get_by_role("heading", level=1, name="Audit")).to_be_visible()
    assert page.evaluate("sessionStorage.getItem('rosrv.token')") == appliance.ready["token"]


def test_a_person_who_waits_can_sign_out(opened: Callable[..., Reader]) -> None:
    reader = opened()
    page = reader.page
    page.clock.install()
    page.route("**/v1/whoami", lambda route: route.fulfill(status=503, json={"detail": "starting"}))
    page.goto(f"{reader.url}/console/now")
    expect(page.get_by_role("alert")).to_contain_text("starting")
    assert reader.axe() == []
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Access token")).to_be_visible()
    assert page.evaluate("sessionStorage.getItem('rosrv.token')") is None
    page.unroute("**/v1/whoami")
    before = len(reader.asked)
    page.clock.fast_forward("01:00")
    expect(page.get_by_label("Access token")).to_be_visible()
    assert reader.asked[before:] == []


def test_a_stored_token_that_was_revoked_is_not_tried_again(
    browser: Browser, appliance: Appliance, token: Callable[..., str]
) -> None:
    revoked = token("viewer", "gone")
    appliance.rosrv("token", "revoke", "gone")
    with Reader(browser, str(appliance.ready["api"]), revoked) as reader:
        reader.page.clock.install()
        reader.page.goto(reader.url)
        ended = reader.page.get_by_role("status").filter(has_text="Signed out")
        expect(ended).to_contain_text("wrong or revoked")
        reader.page.clock.fast_forward("01:00")
        expect(reader.page.get_by_label("Access token")).to_be_visible()
        assert len([url for url in reader.asked if url.endswith("/v1/whoami")]) == 1


def test_a_tab_reloaded_after_hours_asks_for_the_token(opened: Callable[..., Reader]) -> None:
    reader = opened()
    page = reader.go("now")
    expect(page.locator("[data-standing=live]")).to_be_visible()
    assert page.evaluate("sessionStorage.getItem('rosrv.used')") is not None
    page.evaluate("sessionStorage.setItem('rosrv.used', String(Date.now() - 16 * 60000))")
    page.reload()
    expect(page.get_by_label("Access token")).to_be_visible()
    assert page.evaluate("sessionStorage.getItem('rosrv.token')") is None


def test_a_locked_page_shows_another_user_none_of_its_drafts(
    appliance: Appliance, token: Callable[..., str], opened: Callable[..., Reader]
) -> None:
    reader = opened()
    reader.page.clock.install()
    page = reader.go("policy")
    reader.write("[Nodes]\n# not finished")
    page.clock.fast_forward("15:00")
    page.get_by_label("Access token").fill(token("operator", "colleague"))
    page.get_by_role("button", name="Sign in").click()
    expect(page.locator(".who-name")).to_have_text("colleague")
    expect(reader.editor()).to_contain_text("/operator = 10.9.9.9")
    expect(reader.editor()).not_to_contain_text("# not finished")
    assert appliance.rest().get("/v1/policy").json["revision"] == 1


def test_a_viewer_sees_disabled_buttons_with_the_required_role(
    appliance: Appliance, token: Callable[..., str], opened: Callable[..., Reader]
) -> None:
    viewer = token("viewer")
    reader = opened(viewer)
    page = reader.go("policy")
    for name, role in (("Dry run", "operator"), ("Load", "admin")):
        button = page.get_by_role("button", name=name).first
        expect(button).to_have_attribute("aria-disabled", "true")
        expect(button).to_have_attribute(
            "title", f"For the role {role}{'' if role == 'admin' else ' or admin'}; yours is viewer"
        )
        button.click(force=True)
    expect(page.get_by_role("dialog")).to_have_count(0)
    page = reader.go("monitors")
    expect(page.get_by_role("switch").first).to_be_disabled()
    page = reader.go("hosts")
    expect(page.get_by_role("button", name="Enrol a host")).to_have_attribute("aria-disabled", "true")
    rest = appliance.rest(viewer)
    assert rest.post("/v1/policy", {"text": "[Nodes]\n"}, match='"1"').status == 403
    assert rest.get("/v1/policy").json["revision"] == 1
