"""Somebody who reads the console in a real browser, and notices what no page of the appliance may do.

    with Reader(browser, appliance, token) as reader:
        reader.go("audit")
        reader.page.get_by_role("button", name="Verify").click()

On leaving the block it is an error when the page asked another host for anything, broke its own content security
policy, left a script error, or set a cookie.
"""

import urllib.parse
from collections.abc import Iterable
from types import TracebackType
from typing import Any, Self

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, ConsoleMessage, Locator, Page, Request, Response, expect

LIMIT = 30_000  # milliseconds; an answer that is not there by then is not coming
expect.set_options(timeout=LIMIT)
_TELL_VIOLATIONS = """
addEventListener("securitypolicyviolation", (event) =>
  console.error(`violation of ${event.effectiveDirective}: ${event.blockedURI} ${event.sample}`));
"""
_SIGNED_IN = """
if (!sessionStorage.getItem("begun")) {
  sessionStorage.setItem("begun", "1");
  sessionStorage.setItem("rosrv.token", "TOKEN");
}
"""
# What the browser itself says of an answer that is no success; the tests look at what the page says of it.
_OF_THE_BROWSER = ("Failed to load resource", "net::ERR_")


class Reader:
    """One browser window, of this width and theme; without a token it stands at the door."""

    def __init__(
        self,
        browser: Browser,
        url: str,
        token: str | None = None,
        *,
        theme: str = "light",
        width: int = 1440,
        height: int = 900,
    ) -> None:
        self.url = url.rstrip("/")
        self.context = browser.new_context(
            viewport={"width": width, "height": height},
            color_scheme=theme,  # type: ignore[arg-type]  # one of its literals
            ignore_https_errors=True,  # the certificate is the appliance's own; test_rest_network looks at it
            accept_downloads=True,
        )
        self.context.set_default_timeout(LIMIT)
        self.context.add_init_script(_TELL_VIOLATIONS)
        if token is not None:
            self.context.add_init_script(_SIGNED_IN.replace("TOKEN", token))
        self.said: list[str] = []
        self.asked: list[str] = []
        self.refused: list[tuple[int, str]] = []
        self.page: Page = self.context.new_page()
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.said.append(f"error: {error}"))
        self.page.on("request", self._asked)
        self.page.on("response", self._answered)

    def go(self, view: str = "now", *, heading: str | None = None) -> Page:
        """Open a view by its address; returns when its heading is there."""
        self.page.goto(f"{self.url}/console/{view}")
        name = heading or view.partition("?")[0].partition("/")[0].capitalize()
        expect(self.page.get_by_role("heading", level=1, name=name, exact=heading is None)).to_be_visible(
            timeout=LIMIT
        )
        return self.page

    def editor(self) -> Locator:
        """The lines of the (first) editor."""
        return self.page.locator("[data-editor] .cm-content").first

    def write(self, text: str) -> None:
        """Replace all that is in the editor."""
        self.editor().click()
        self.page.keyboard.press("Control+a")
        self.page.keyboard.insert_text(text)

    def toast(self, text: str) -> Locator:
        """What the page says was done."""
        return self.page.locator(".toasts").get_by_text(text)

    def settle(self) -> None:
        """Wait until what the view shows is there, and no colour is on its way to another."""
        expect(self.page.locator(".skeleton")).to_have_count(0)
        self.page.wait_for_function(
            "document.fonts.status === 'loaded' && document.getAnimations().every(one => one.playState !== 'running')"
        )

    def fits(self) -> None:
        """Wait until the page is no wider than its window; fails when it stays wider."""
        self.page.wait_for_function("document.documentElement.scrollWidth <= innerWidth")

    def axe(self) -> list[str]:
        """What axe-core finds against WCAG 2.2 AA and its good practices, when the view stands still."""
        self.settle()
        found = Axe().run(
            self.page,
            options={
                "resultTypes": ["violations"],
                "runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"],
            },
        )
        return [
            f"{one['id']}: {one['help']}: " + "; ".join(str(node["target"]) for node in one["nodes"][:4])
            for one in found.response["violations"]
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        cookies = self.context.cookies()
        self.context.close()
        if kind is None:
            assert self.foreign() == [], f"the page asked elsewhere: {self.foreign()}"
            assert self.said == [], f"the page complained: {self.said}"
            assert cookies == [], f"the page has cookies: {cookies}"

    def foreign(self) -> list[str]:
        """Requests to anywhere else."""
        own = urllib.parse.urlsplit(self.url).netloc
        return [
            url
            for url in self.asked
            if urllib.parse.urlsplit(url).scheme not in ("data", "blob")
            and urllib.parse.urlsplit(url).netloc != own
        ]

    def _heard(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning") and not any(word in message.text for word in _OF_THE_BROWSER):
            self.said.append(f"{message.type}: {message.text}")

    def _asked(self, request: Request) -> None:
        self.asked.append(request.url)

    def _answered(self, response: Response) -> None:
        if response.status >= 400:
            self.refused.append((response.status, response.url))


def texts(locators: Iterable[Any]) -> list[str]:
    """What stands in each."""
    return [str(one.inner_text()) for one in locators]
