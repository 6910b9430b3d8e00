"""Serve the console: one page for operators, with all its files.

Invariants:

1. The files are part of the program, need no token and contain no secret. Only the site's notice, and the time after
   which the page locks, are settings. The page requests its content from `/v1` with its reader's token.
2. Only files that existed when the routes were made are served, by exact name: a request's path never reaches the file
   system.
3. The headers restrict the page to this origin, for loading and for connections, and to its own scripts. A string never
   becomes markup (Trusted Types).
"""

import hashlib
import html
import mimetypes
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import NamedTuple

from fastapi import APIRouter, Request
from starlette.responses import Response

from appliance.api.problems import ProblemError
from appliance.configuration.settings import Settings

VIEWS = ("now", "graph", "audit", "policy", "monitors", "hosts", "recordings")
_PREFIX = "/console/static/"
_TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".woff2": "font/woff2"}
_HEADERS = {
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
    etag: str


def routes(settings: Settings) -> APIRouter:
    """Return the routes, which are not part of the contract."""
    router = APIRouter(include_in_schema=False)
    served = _collect(files("appliance.api") / "console", "")
    page = served["index.html"] = _stating(
        served["index.html"],
        {"lock-seconds": f"{settings.api_lock_seconds:g}", "notice": settings.api_notice},
    )

    async def index(request: Request) -> Response:
        """Answer with the page; its address selects the view."""
        return _answer(request, page)

    async def file(request: Request, name: str) -> Response:
        """Answer with one of the page's files."""
        found = served.get(name)
        if found is None:
            raise ProblemError(404, "unknown-path", "the console has no such file")
        return _answer(request, found)

    methods = ["GET", "HEAD"]
    router.add_api_route(_PREFIX + "{name:path}", file, methods=methods)
    for path in ("/", "/console", "/console/"):
        router.add_api_route(path, index, methods=methods)
    for view in VIEWS:
        router.add_api_route(f"/console/{view}", index, methods=methods)
        router.add_api_route(f"/console/{view}/{{rest:path}}", index, methods=methods)
    return router


def _answer(request: Request, found: _File) -> Response:
    headers = {**_HEADERS, "ETag": found.etag}
    if request.headers.get("if-none-match") == found.etag:
        return Response(status_code=304, headers=headers)
    return Response(found.body, headers=headers, media_type=found.media_type)


def _collect(folder: Traversable, prefix: str) -> dict[str, _File]:
    """Return all files under a folder, by their paths relative to it."""
    found: dict[str, _File] = {}
    for entry in folder.iterdir():
        if entry.is_dir():
            found |= _collect(entry, f"{prefix}{entry.name}/")
            continue
        found[prefix + entry.name] = _file(entry.read_bytes(), _media_type(entry.name))
    return found


def _stating(page: _File, said: dict[str, str]) -> _File:
    """Return the page with the site's settings in its `meta` elements."""
    body = page.body.decode()
    for name, text in said.items():
        empty = f'<meta name="rosrv:{name}" content="'
        before, found, after = body.partition(empty)
        assert found, name  # noqa: S101  the page has a `meta` element for each setting
        body = f"{before}{found}{html.escape(text)}{after}"
    return _file(body.encode(), page.media_type)


def _file(body: bytes, media_type: str) -> _File:
    return _File(body, media_type, f'"{hashlib.sha256(body).hexdigest()[:32]}"')


def _media_type(name: str) -> str:
    ending = name[name.rfind(".") :]
    return _TYPES.get(ending) or mimetypes.guess_type(name)[0] or "application/octet-stream"
