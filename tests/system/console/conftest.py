import json
import os
import xmlrpc.client
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Playwright, sync_playwright

from tests.support.appliance import Appliance
from tests.support.requirements import need_program
from tests.system.console.reader import Reader

POLICY = """\
[Nodes]
default = *
/operator = 10.9.9.9

[Publishers]
default = *
/guarded = 10.9.9.9                 # nobody here

[Subscribers]
default = *

[Commands]
default = *
shutdown = 10.9.9.9
"""
REPOSITORY = Path(__file__).resolve().parents[3]
CONFIG = "api: 127.0.0.1:0\napi_tls: off\napi_limits: {requests_per_second: 500, burst: 2000}\n"


@pytest.fixture(scope="session")
def chromium() -> str:
    return need_program("chromium", "chromium")


@pytest.fixture(scope="module")  # its event loop must not outlive the file
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as driver:
        yield driver


@pytest.fixture(scope="module")
def browser(chromium: str, playwright: Playwright) -> Iterator[Browser]:
    started = launch(playwright, chromium)
    yield started
    started.close()


def launch(playwright: Playwright, program: str, *options: str) -> Browser:
    """Start the browser. As root it has no sandbox, because Chromium's sandbox does not run as root."""
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    return playwright.chromium.launch(executable_path=program, args=[*arguments, *options])


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    config = tmp_path_factory.mktemp("console") / "appliance.yaml"
    config.write_text(CONFIG)
    options = ("--config", str(config), "--monitors", str(REPOSITORY / "monitors"))
    with Appliance(policy=POLICY, options=options) as running:
        yield running


@pytest.fixture
def token(appliance: Appliance) -> Callable[..., str]:
    def make(role: str, name: str | None = None, expires: str = "1d") -> str:
        made = appliance.rosrv(
            "token", "add", name or f"some-{role}", "--role", role, "--for", expires, "--json"
        )
        return str(json.loads(made.stdout)["token"])

    return make


@pytest.fixture
def opened(browser: Browser, appliance: Appliance) -> Iterator[Callable[..., Reader]]:
    with ExitStack() as stack:

        def open_window(token: str | None = None, **look: Any) -> Reader:
            given = token or str(appliance.ready["token"])
            return stack.enter_context(Reader(browser, str(appliance.ready["api"]), given, **look))

        yield open_window


@pytest.fixture
def attempt(appliance: Appliance) -> Callable[..., Any]:
    def call(method: str, *arguments: Any) -> Any:
        with xmlrpc.client.ServerProxy(appliance.master_uri, allow_none=True) as master:
            try:
                return getattr(master, method)(*arguments)
            except xmlrpc.client.Error as error:
                return error

    return call
