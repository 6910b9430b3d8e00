from collections.abc import Callable

from playwright.sync_api import Browser, expect

from appliance.api.console.console_bundle import join_modules
from tests.support.appliance import Appliance
from tests.support.waiting import eventually
from tests.system.console.reader import Reader

MAX_REQUESTS = 10
MAX_BYTES = 180_000  # on the wire, with the headers
MODULES = {
    "main.js": (
        'import { tell } from "./other.js";\nimport { tell as again, Told, calls } from "./deep/third.js";\n'
        'const hidden = "main"; // a comment\ntell(hidden);\nagain(`${hidden}  // text`);\n'
        'console.log(new Told().text, calls.join());\n'
    ),
    "other.js": (
        'const hidden = "other";\nconsole.log("once");\n'
        "export function tell(text) { console.log(hidden, text); }\n"
    ),
    "deep/third.js": (
        'import { tell as other } from "./../other.js";\nconst hidden = "third";\nexport const calls = [];\n'
        "export class Told { text = hidden.replace(/[/]|h/, 'H'); }\n"
        "export function tell(text) { calls.push(text.length / 2 / 1); other(`${hidden} ${text}`); }\n"
    ),
}  # fmt: skip


def test_a_first_visit_is_small(
    browser: Browser, appliance: Appliance, record_property: Callable[[str, object], None]
) -> None:
    with Reader(browser, str(appliance.ready["api"])) as reader:
        network = reader.context.new_cdp_session(reader.page)
        received: list[int] = []
        network.on("Network.loadingFinished", lambda event: received.append(event["encodedDataLength"]))
        network.send("Network.enable")
        page = reader.page
        page.goto(reader.url)
        expect(page.get_by_label("Access token")).to_be_visible()
        reader.settle()
        assert len(reader.asked) < MAX_REQUESTS, reader.asked
        page.get_by_label("Access token").fill(str(appliance.ready["token"]))
        page.keyboard.press("Enter")
        expect(page.get_by_role("heading", level=1, name="Now")).to_be_visible()
        reader.settle()
        record_property("bytes", sum(received))
        assert sum(received) < MAX_BYTES


def test_joined_modules_run_as_they_would_alone(browser: Browser) -> None:
    page = browser.new_page()
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.add_script_tag(content=join_modules(MODULES, "main.js")["main.js"], type="module")
    expected = ["once", "other main", "other third main  // text", "tHird 6.5"]
    eventually(lambda: page.evaluate("true") and len(said) >= len(expected), "the modules' output")
    assert said == expected
    page.close()
