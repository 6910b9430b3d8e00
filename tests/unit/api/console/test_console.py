import hashlib
import json
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, Request

import appliance.api
from appliance.api.console.console import routes, views
from appliance.api.front.problems import ProblemError
from appliance.api.front.request_gate import is_console
from appliance.configuration.settings import Settings
from appliance.policy import sections
from appliance.policy.model import Category
from tests.support.asgi import requested
from tests.support.rows import require_rows

FILES = Path(appliance.api.__file__).parent / "console"
VENDOR = FILES / "vendor"
OF_FEATURES = FILES.parents[1] / "features"
SOURCES = sorted([*(FILES / "js").rglob("*.js"), *OF_FEATURES.glob("*/console/**/*.js")])
FIRST_SCRIPT = (
    45_000  # bytes on the wire, of the 220,000 of a first visit; the rest is for fonts, styles and answers
)
IMPORT = re.compile(r"""(?:from|import)\s+"([^"]+)"|import\("([^"]+)"\)""")
# Names of XML vocabularies; nothing is fetched from them.
NAMESPACES = re.compile(
    r"http://www\.w3\.org/(2000/svg|1999/xhtml|1998/Math/MathML|1999/xlink|2000/xmlns/|XML/1998/namespace)"
)


class Client:
    def __init__(self, settings: Settings) -> None:
        async def problem(_request: Request, error: Any) -> Any:
            return error.response()

        app = FastAPI(exception_handlers={ProblemError: problem})
        app.include_router(routes(settings))
        self._app = app

    def get(self, path: str, headers: dict[str, str] | None = None) -> httpx.Response:
        return requested(self._app, "GET", path, headers=headers)


@pytest.fixture(scope="module")
def client() -> Client:
    return Client(Settings())


def test_the_page_is_served_at_every_view(client: Client) -> None:
    paths = ["/", "/console", "/console/", *(f"/console/{view}" for view in views()), "/console/audit/813"]
    [page] = {client.get(path).text for path in paths}
    assert '<meta name="rosrv:lock-seconds" content="900">' in page
    assert client.get("/console/elsewhere").status_code == 404


def test_the_page_shows_the_configured_notice() -> None:
    told = Client(Settings(api_notice='<b>"Staff" only</b>\n&', api_lock_seconds=60)).get("/console")
    assert 'name="rosrv:lock-seconds" content="60"' in told.text
    assert 'name="rosrv:notice" content="&lt;b&gt;&quot;Staff&quot; only&lt;/b&gt;\n&amp;"' in told.text
    assert told.headers["etag"] != Client(Settings()).get("/console").headers["etag"]


def test_the_headers_close_the_page(client: Client) -> None:
    for path in ("/", "/console/static/js/main.js"):
        headers = client.get(path).headers
        policy = dict(
            part.strip().partition(" ")[::2] for part in headers["content-security-policy"].split(";")
        )
        assert policy == {
            "default-src": "'none'", "script-src": "'self'", "style-src": "'self'", "img-src": "'self' data:",
            "connect-src": "'self'", "font-src": "'self'", "base-uri": "'none'", "form-action": "'none'",
            "frame-ancestors": "'none'", "require-trusted-types-for": "'script'", "trusted-types": "'none'",
        }  # fmt: skip
        assert headers["cross-origin-opener-policy"] == "same-origin"
        assert headers["x-frame-options"] == "DENY"


def test_a_cached_file_is_not_sent_again(client: Client) -> None:
    first = client.get("/console/static/js/main.js")
    assert first.headers["content-type"].startswith("text/javascript")
    assert first.headers["cache-control"] == "no-cache"
    again = client.get("/console/static/js/main.js", headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert client.get("/console/static/css/base.css").headers["etag"] != first.headers["etag"]


def test_the_files_of_the_page_are_cached_for_good_and_compressed(client: Client) -> None:
    seen = {"/console"}
    todo = ["/console"]
    while todo:
        text = client.get(todo.pop()).text
        for address in set(re.findall(r"/console/static/[\w./-]+", text)) - seen:
            seen.add(address)
            answer = client.get(address, headers={"Accept-Encoding": "gzip"})
            assert answer.headers["cache-control"] == "public, max-age=31536000, immutable", address
            assert address.rsplit(".", 2)[1] == hashlib.sha256(answer.content).hexdigest()[:32]
            if address.endswith((".js", ".css")):
                assert answer.headers["content-encoding"] == "gzip", address
                todo.append(address)
            plain = client.get(address, headers={"Accept-Encoding": "gzip;q=0"})
            assert "content-encoding" not in plain.headers
            assert plain.content == answer.content
            assert plain.headers["etag"] != answer.headers["etag"] or not address.endswith((".js", ".css"))
    assert {Path(address).name.partition(".")[0] for address in seen} == {
        "console", "early", "main", "preact", "dagre", "codemirror", "inter", "jetbrains-mono", "icon", "icon-calls",
        "view", "panel", "own", "taking", "results", "search",
    }  # fmt: skip


def test_a_repeated_request_waits_for_its_answer_and_shows_its_age() -> None:
    """A timer of its own would cut off each answer that takes longer than its pause."""
    texts = {source: source.read_text() for source in SOURCES}
    assert [one.name for one, text in texts.items() if re.search(r"setInterval\([^\n]*\bagain\b", text)] == []
    repeated = [text for text in texts.values() if re.search(r"useResource\(.*\], [^)]", text)]
    assert len(repeated) == 5
    assert all("heard=${heard}" in text or "error && heard" in text for text in repeated)
    own = [one.name for one, text in texts.items() if re.search(r"=> \(\{ \.\.\.\w+, error \}\)", text)]
    assert sorted(own) == ["belief.js", "pad.js", "records.js", "resource.js"], (
        "others use useResource or useFollowed"
    )


def test_a_view_is_loaded_when_it_is_opened(client: Client) -> None:
    """Each module is in the page's script or in late ones, and in none twice."""
    [name] = re.findall(r"/console/static/js/main\.\w+\.js", client.get("/console").text)
    scripts = {name: client.get(name).text}
    todo = [name]
    while todo:
        for late in re.findall(r'\$late\("([^"]+)"\)', scripts[todo.pop()]):
            if late not in scripts:
                scripts[late] = client.get(late).text
                todo.append(late)
    made = {
        one: re.findall(r"^(\$m\[\d+\])\?\?=\(\(\)=>", text, re.MULTILINE) for one, text in scripts.items()
    }
    late_ones = {number for one, numbers in made.items() if one != name for number in numbers}
    assert not late_ones & set(made[name])
    assert all(len(set(numbers)) == len(numbers) for numbers in made.values())
    assert len(late_ones) + len(made[name]) == len(SOURCES) - len({"early.js"})
    for text in scripts.values():
        assert "@param" not in text
        imports = [line for line in text.splitlines() if line.startswith("import ")]
        assert [line for line in imports if "/vendor/" not in line] == []
    first = client.get(name, headers={"Accept-Encoding": "gzip"})
    assert int(first.headers["content-length"]) < FIRST_SCRIPT
    assert not any(
        f"function {view}(" in scripts[name] for view in ("Audit", "GraphView", "Recordings", "Teleop")
    )


# Why these may read the browser's wall clock: no time of the appliance is compared with it.
WALL_CLOCK = {
    "elapsed.js": "measures how long something takes, beside the monotonic clock",
    "live.js": "before the time of the appliance is known",
    "session.js": "the last use of this tab, which only this browser stores",
    "denied_hosts.js": "the pause between two requests",
    "rates.js": "the axis of charts whose points this browser timed",
    "plot.js": "the axis of a chart without points",
}


def test_times_of_the_appliance_are_not_compared_with_the_clock_of_a_browser() -> None:
    reading = {
        file.name for file in SOURCES if re.search(r"Date\.now\(\)|new Date\(\)\.get", file.read_text())
    }
    assert reading == set(WALL_CLOCK)


@pytest.mark.parametrize(
    "path",
    [
        "../console.py", "..%2Fconsole.py", "%2e%2e/console.py", "js/../../console.py", "/etc/passwd", "js", "",
        "JS/main.js",
    ],
)  # fmt: skip
def test_only_the_consoles_files_are_served(client: Client, path: str) -> None:
    assert client.get(f"/console/static/{path}").status_code == 404


@pytest.mark.parametrize("path", ["/consolex", "/v1/console", "/console.py", "//console/now"])
def test_only_the_console_needs_no_token(path: str) -> None:
    assert not is_console(path)


def test_the_manifest_lists_all_vendored_files() -> None:
    manifest = json.loads((VENDOR / "manifest.json").read_text())["files"]
    assert set(manifest) == {path.name for path in VENDOR.iterdir()} - {"manifest.json"}
    licences = (VENDOR / "LICENCES.txt").read_text()
    for name, entry in manifest.items():
        assert hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() == entry["sha256"], name
        for package in entry["packages"]:
            assert package["licence"] in ("MIT", "Apache-2.0", "OFL-1.1"), package
            assert f"{package['name']} {package['version']}" in licences, package


def test_vendored_versions_match_the_lock_file() -> None:
    lock = json.loads((FILES.parents[2] / "console" / "package-lock.json").read_text())["packages"]
    manifest = json.loads((VENDOR / "manifest.json").read_text())["files"]
    for entry in manifest.values():
        for package in entry["packages"]:
            assert lock[f"node_modules/{package['name']}"]["version"] == package["version"]


@pytest.mark.parametrize(
    "path", sorted(p for p in FILES.rglob("*") if p.suffix in (".js", ".css", ".html", ".svg")), ids=str
)
def test_no_file_names_another_host(path: Path) -> None:
    text = NAMESPACES.sub("", path.read_text())
    assert re.findall(r"(?:https?:|wss?:)?//[a-z0-9-]+\.[a-z]{2,}[^\s\"'`]*", text) == []


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(FILES.parents[1])))
def test_sources_import_served_files_and_make_no_markup(path: Path) -> None:
    text = path.read_text()
    for relative, dynamic in IMPORT.findall(text):
        name = relative or dynamic
        if name.startswith("#console/"):
            target = FILES / "js" / name.removeprefix("#console/")
        else:
            target = (
                FILES / name.removeprefix("/console/static/") if name.startswith("/") else path.parent / name
            )
        assert target.resolve().is_file(), name
    for word in (
        "innerHTML",
        "outerHTML",
        "insertAdjacentHTML",
        "document.write",
        "eval(",
        "new Function",
        "document.cookie",
    ):
        assert word not in text, word
    assert len(text.splitlines()) <= 400


def test_the_page_has_nothing_inline() -> None:
    page = (FILES / "index.html").read_text()
    assert re.findall(r"<script(?![^>]*\bsrc=)|<style|\son\w+=|\sstyle=", page) == []
    for name in re.findall(r'(?:src|href)="/console/static/([^"]+)"', page):
        assert (FILES / name).is_file(), name


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_has_enough_contrast(theme: str) -> None:
    css = (FILES / "css" / "tokens.css").read_text()
    blocks = css.split(':root[data-theme="dark"]')
    tokens = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", blocks[0]))
    if theme == "dark":
        tokens |= dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", blocks[1]))
    pairs = [
        (text, surface)
        for text in ("text", "muted", "accent")
        for surface in ("page", "surface", "sunken", "hover")
    ]
    pairs += [(tone, f"{tone}-soft") for tone in ("allow", "deny", "warn", "note")]
    pairs += [
        (tone, "surface")
        for tone in (
            "allow",
            "deny",
            "warn",
            "mediated",
            "code-key",
            "code-section",
            "code-comment",
            "code-string",
            "code-number",
        )
    ]
    pairs += [("on-accent", "accent-fill"), ("text", "chosen"), ("muted", "chosen")]
    low = {pair: round(_contrast(tokens[pair[0]], tokens[pair[1]]), 2) for pair in pairs}
    assert {pair: ratio for pair, ratio in low.items() if ratio < 4.5} == {}


def _contrast(one: str, other: str) -> float:
    lights = sorted((_luminance(one), _luminance(other)))
    return (lights[1] + 0.05) / (lights[0] + 0.05)


def _luminance(colour: str) -> float:
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    red, green, blue = (
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
    )
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@pytest.mark.complete
def test_the_editor_completes_every_section() -> None:
    text = (FILES / "js" / "policy" / "complete.js").read_text()
    table = text.partition("SECTIONS = ")[2].partition("});")[0]
    require_rows(
        sections.NAMES, re.findall(r"^  (\w+): {", table, re.MULTILINE), "SECTIONS of js/policy/complete.js"
    )


@pytest.mark.complete
def test_the_console_explains_every_category_of_decision() -> None:
    text = (FILES / "js" / "categories.js").read_text()
    require_rows(Category, re.findall(r'\["(\w+)", "', text), "js/categories.js of the console")
