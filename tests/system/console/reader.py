"""Use the console in a real browser, and check that the page does nothing forbidden.

Leaving the block fails if the page requested anything from another host, violated its own content security policy,
raised a script error, or set a cookie.
"""

import re
import urllib.parse
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, ConsoleMessage, Locator, Page, Request, Response, expect

from tests.support.processes import LIMIT as SECONDS
from tests.support.waiting import eventually

PICTURES = Path(__file__).resolve().parents[3] / "build" / "console"
LIMIT = 2000 * SECONDS  # milliseconds to wait for an answer
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
# Whether an element is in the window of a page that is not scrolled, with nothing over its middle.
_SEEN_AT_ONCE = """(element) => {
  const { left, right, top, bottom, width, height } = element.getBoundingClientRect();
  if (scrollY || !width || !height || left < 0 || top < 0 || right > innerWidth || bottom > innerHeight) return false;
  const above = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
  return element.contains(above);
}"""
# The browser's own messages about failed requests; tests check the page's messages instead.
_BROWSER_MESSAGES = ("Failed to load resource", "net::ERR_")


class Reader:
    def __init__(
        self,
        browser: Browser,
        url: str,
        token: str | None = None,
        *,
        theme: str = "light",
        width: int = 1440,
        height: int = 900,
        zone: str | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        self.context = browser.new_context(
            viewport={"width": width, "height": height},
            timezone_id=zone,
            color_scheme=theme,  # type: ignore[arg-type]  # one of its literals
            ignore_https_errors=True,  # test_rest_network checks the certificate
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
        self.page.goto(f"{self.url}/console/{view}")
        name = heading or view.partition("?")[0].partition("/")[0].capitalize()
        expect(self.page.get_by_role("heading", level=1, name=name, exact=heading is None)).to_be_visible(
            timeout=LIMIT
        )
        return self.page

    def editor(self) -> Locator:
        return self.page.locator("[data-editor] .cm-content").first

    def write(self, text: str) -> None:
        self.editor().click()
        self.page.keyboard.press("Control+a")
        self.page.keyboard.insert_text(text)

    def toast(self, text: str) -> Locator:
        return self.page.locator(".toasts").get_by_text(text)

    def settle(self) -> None:
        expect(self.page.locator(".skeleton")).to_have_count(0)
        wait_until(
            self.page,
            "document.fonts.status === 'loaded' && document.getAnimations().every(one => one.playState !== 'running')",
        )

    def fits(self) -> None:
        wait_until(self.page, "document.documentElement.scrollWidth <= innerWidth")

    def sees(self, locator: Locator, text: str | re.Pattern[str]) -> None:
        """Wait until the element has the text and is seen without scrolling."""
        expect(locator.first).to_contain_text(text)
        eventually(lambda: locator.first.evaluate(_SEEN_AT_ONCE), f"{text} is seen without scrolling")

    def keep_picture(self, name: str) -> None:
        """Save what the window shows without scrolling, for people, as `build/console/NAME-WIDTH.png`."""
        size = self.page.viewport_size
        assert size is not None
        self.page.screenshot(path=PICTURES / f"{name}-{size['width']}.png")

    def axe(self) -> list[str]:
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
            assert self.foreign() == [], f"the page made requests to other hosts: {self.foreign()}"
            assert self.said == [], f"the page logged errors: {self.said}"
            assert cookies == [], f"the page set cookies: {cookies}"

    def foreign(self) -> list[str]:
        own = urllib.parse.urlsplit(self.url).netloc
        return [
            url
            for url in self.asked
            if urllib.parse.urlsplit(url).scheme not in ("data", "blob")
            and urllib.parse.urlsplit(url).netloc != own
        ]

    def _heard(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning") and not any(
            word in message.text for word in _BROWSER_MESSAGES
        ):
            self.said.append(f"{message.type}: {message.text}")

    def _asked(self, request: Request) -> None:
        self.asked.append(request.url)

    def _answered(self, response: Response) -> None:
        if response.status >= 400:
            self.refused.append((response.status, response.url))


def texts(locators: Iterable[Any]) -> list[str]:
    return [str(locator.inner_text()) for locator in locators]


def wait_until(page: Page, condition: str) -> None:
    """Wait without `Page.wait_for_function`, whose evaluation the page's content security policy forbids."""
    eventually(lambda: page.evaluate(condition), condition)
