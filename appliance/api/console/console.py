"""Serve the console: one page for operators, with all its files.

1. The files are part of the program, need no token and contain no secret.
2. Only files that existed when the routes were made are served, by exact name: no path of a request reaches the disk.
3. The headers restrict the page to this origin and its own scripts. No string becomes markup (Trusted Types).
"""

import gzip
import hashlib
import html
import json
import mimetypes
import re
from collections.abc import Iterable, Mapping
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import NamedTuple

from fastapi import APIRouter, Request
from starlette.responses import Response

from appliance.api.console.console_bundle import ModuleError, join_modules, join_styles
from appliance.api.front.problems import ProblemError
from appliance.configuration.settings import Settings
from appliance.features.feature import ConsolePart, Feature
from appliance.features.table import FEATURES, FOLDERS

_VIEWS = ("now", "graph", "audit", "policy", "monitors", "robot")
_PREFIX = "/console/static/"
# The other files of the folder are Python.
_SERVED = ("css", "icon-calls.svg", "icon.svg", "index.html", "js", "vendor")
_PAGE, _SCRIPT, _STYLE, _PARTS = "index.html", "js/main.js", "css/main.css", "js/features.js"
_LATE = ("view", "robot", "record")
_ADDRESS = re.compile(rf"{_PREFIX}([\w./-]++)")
_GZIP = re.compile(r"\bgzip\b(?!\s*+;\s*+q=0(?:\.0*+)?\s*+(?:,|$))", re.IGNORECASE)
_LEVEL = 9  # of gzip; the files are compressed once
_TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".woff2": "font/woff2"}
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self';"
        " font-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none';"
        " require-trusted-types-for 'script'; trusted-types 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    "X-Frame-Options": "DENY",
    "Cache-Control": "no-cache",  # revalidate cached files by ETag, so that an update takes effect at once
}


class _File(NamedTuple):
    body: bytes
    media_type: str
    digest: str
    packed: bytes | None = None  # gzip, of lasting files that it makes smaller
    lasting: bool = False  # its address changes with its content


def routes(settings: Settings) -> APIRouter:
    """Return the routes, which are not part of the contract. Raises `ModuleError` if the modules cannot be joined."""
    router = APIRouter(include_in_schema=False)
    served = _served(settings)

    async def index(request: Request) -> Response:
        return _answer(request, served[_PAGE])

    async def file(request: Request, name: str) -> Response:
        found = served.get(name)
        if found is None:
            raise ProblemError(404, "unknown-path", "the console has no such file")
        return _answer(request, found)

    router.add_api_route(_PREFIX + "{name:path}", file)
    for path in ("/", "/console", "/console/"):
        router.add_api_route(path, index)
    for view in views():
        router.add_api_route(f"/console/{view}", index)
        router.add_api_route(f"/console/{view}/{{rest:path}}", index)
    return router


def _served(settings: Settings) -> dict[str, _File]:
    """Return the files by name, with the page for these settings."""
    served = _collect((files(__package__) / name for name in _SERVED), "")
    parts = {name: feature.console for name, feature in FOLDERS.items() if isinstance(feature, Feature)}
    for name, of_feature in parts.items():
        if of_feature:
            folder = files(f"appliance.features.{name}") / "console"
            served |= _collect(folder.iterdir(), f"features/{name}/")
    texts = {name: served[name].body.decode() for name in served if name.endswith((".js", ".css", ".html"))}
    texts[_PARTS] = _parts(parts)
    styles = [name for name in texts if name.startswith("features/") and name.endswith(".css")]
    joined = {
        **join_modules(texts, _SCRIPT, _PREFIX),
        _STYLE: "".join(join_styles(texts, one) for one in (_STYLE, *styles)),
    }
    page = _stating(_with_lasting_files(texts[_PAGE], joined, served), _stated(settings))
    served[_PAGE] = _file(page.encode(), served[_PAGE].media_type)
    return served


def _with_lasting_files(page: str, joined: Mapping[str, str], served: dict[str, _File]) -> str:
    """Add the files that the page names, directly or not, under lasting addresses; return the page with those."""
    addresses: dict[str, str] = {}

    def named(match: re.Match[str]) -> str:
        name = match[1]
        if name not in served:
            raise ModuleError(f"the console names {_PREFIX}{name}, which does not exist")
        if name not in addresses:
            addresses[name] = ""  # until its content is known
            body = _ADDRESS.sub(named, joined[name]).encode() if name in joined else served[name].body
            lasting = _file(body, served[name].media_type, lasting=True)
            stem, _, ending = name.rpartition(".")
            addresses[name] = f"{stem}.{lasting.digest}.{ending}"
            served[addresses[name]] = lasting
        if not addresses[name]:
            raise ModuleError(f"the console's script {name} loads itself late")
        return _PREFIX + addresses[name]

    return _ADDRESS.sub(named, page)


def _stated(settings: Settings) -> dict[str, str]:
    sections = settings.sections.values.values()
    return {
        "lock-seconds": f"{settings.api_lock_seconds:g}",
        "notice": settings.api_notice,
        "robot": settings.name,
        **{name: text for section in sections for name, text in section.on_page().items()},
    }


def views() -> tuple[str, ...]:
    parts = (part for feature in FEATURES for part in feature.console if part.place == "view")
    return (*_VIEWS, *(part.title.lower() for part in parts))


def _parts(of_features: Mapping[str, tuple[ConsolePart, ...]]) -> str:
    """Return the module of the features' components. A component with a page of its own is loaded with that page."""
    imports: list[str] = ['import { late } from "./parts/late.js";\n']
    rows: list[str] = []
    parts = ((name, part) for name, parts in of_features.items() for part in parts)
    for name, part in sorted(parts, key=lambda row: row[1].order):
        address = f'"../features/{name}/{part.file}"'
        shown = f"part{len(rows)}"
        if part.place in _LATE:
            shown = f"late(() => import({address}), {json.dumps(part.component)})"
        elif part.place == "search":
            shown = f"async () => (await import({address}))[{json.dumps(part.component)}]"
        else:
            imports.append(f"import {{ {part.component} as {shown} }} from {address};\n")
        rows.append(
            f"{{ place: {json.dumps(part.place)}, title: {json.dumps(part.title)}, Part: {shown} }},\n"
        )
    return "".join([*imports, "export const PARTS = [", *rows, "];\n"])


def _answer(request: Request, file: _File) -> Response:
    packed = file.packed if _GZIP.search(request.headers.get("accept-encoding", "")) else None
    etag = f'"{file.digest}{"-gzip" if packed else ""}"'
    headers = {**HEADERS, "ETag": etag, "Vary": "Accept-Encoding"}
    if file.lasting:
        headers["Cache-Control"] = "public, max-age=31536000, immutable"
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=304, headers=headers)
    if packed:
        headers["Content-Encoding"] = "gzip"
    return Response(packed or file.body, headers=headers, media_type=file.media_type)


def _collect(entries: Iterable[Traversable], prefix: str) -> dict[str, _File]:
    found: dict[str, _File] = {}
    for entry in entries:
        if entry.is_dir():
            found |= _collect(entry.iterdir(), f"{prefix}{entry.name}/")
            continue
        found[prefix + entry.name] = _file(entry.read_bytes(), _media_type(entry.name))
    return found


def _stating(page: str, said: dict[str, str]) -> str:
    for name, text in said.items():
        empty = f'<meta name="rosrv:{name}" content="'
        before, found, after = page.partition(empty)
        assert found, name  # noqa: S101  the page has a `meta` element for each setting
        page = f"{before}{found}{html.escape(text)}{after}"
    return page


def _file(body: bytes, media_type: str, *, lasting: bool = False) -> _File:
    packed = gzip.compress(body, _LEVEL, mtime=0) if lasting else body
    digest = hashlib.sha256(body).hexdigest()[:32]
    return _File(body, media_type, digest, packed if len(packed) < len(body) else None, lasting)


def _media_type(name: str) -> str:
    ending = name[name.rfind(".") :]
    return _TYPES.get(ending) or mimetypes.guess_type(name)[0] or "application/octet-stream"
