"""The contract as a page for people, without scripts; all texts are escaped."""

import json
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

from appliance.api.routes.contract import GENERAL

PATH = "/v1/openapi.html"
_STYLE = "/console/static/css/contract.css"
_ROLES = "docs/reference/rest.md"
_Json = Mapping[str, Any]


def page_of(document: _Json) -> str:
    return "".join(_lines(document))


def _lines(document: _Json) -> Iterator[str]:
    info, tags = document["info"], _by_tag(document)
    title = escape(f"REST of the {info['title']}, version {info['version']}")
    yield f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield '<link rel="icon" href="/console/static/icon.svg" type="image/svg+xml">'
    yield f'<link rel="stylesheet" href="{_STYLE}"></head><body><main><h1>{title}</h1>'
    yield f"<p>{escape(info['description'])}</p>"
    yield f'<p>For programs: <a href="/v1/openapi.json">OpenAPI 3.1</a>. Roles and conventions: {_ROLES}.</p><nav>'
    for tag in tags:
        yield f'<a href="#{escape(tag)}">{escape(tag)}</a> '
    yield "</nav>"
    general: dict[str, str] = {}
    for tag, operations in tags.items():
        yield f'<h2 id="{escape(tag)}">{escape(tag)}</h2>'
        for method, path, operation in operations:
            general |= {
                one: found["description"] for one, found in operation["responses"].items() if one in GENERAL
            }
            yield from _operation(method, path, operation, document)
    yield '<h2 id="every">Answers that each call may give</h2><dl>'
    for status, text in sorted(general.items()):
        yield f"<dt>{status}</dt><dd>{escape(text)}</dd>"
    yield "</dl></main></body></html>\n"


def _by_tag(document: _Json) -> dict[str, list[tuple[str, str, _Json]]]:
    found: dict[str, list[tuple[str, str, _Json]]] = {}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            found.setdefault(operation.get("tags", ["other"])[0], []).append(
                (method.upper(), path, operation)
            )
    return dict(sorted(found.items()))


def _operation(method: str, path: str, operation: _Json, document: _Json) -> Iterator[str]:
    name = escape(operation["operationId"])
    yield f'<section id="{name}"><h3><a href="#{name}"><code>{method} {escape(path)}</code></a></h3>'
    yield f"<p>{escape(operation.get('description') or operation.get('summary', ''))}</p>"
    if parameters := operation.get("parameters"):
        yield "<table><thead><tr><th>Parameter</th><th>In</th><th>Meaning</th></tr></thead><tbody>"
        for parameter in parameters:
            words = parameter.get("description") or parameter["schema"].get("description", "")
            need = " (required)" if parameter.get("required") else ""
            yield f"<tr><td><code>{escape(parameter['name'])}</code>{need}</td>"
            yield f"<td>{parameter['in']}</td><td>{escape(words)}</td></tr>"
        yield "</tbody></table>"
    yield from _content("Body", operation.get("requestBody", {}).get("content", {}), document)
    for status, response in operation["responses"].items():
        if status.startswith("2"):
            yield from _content(f"Answer {status}", response.get("content", {}), document)
    others = [
        f"<dt>{status}</dt><dd>{escape(response['description'])}</dd>"
        for status, response in sorted(operation["responses"].items())
        if not status.startswith("2") and status not in GENERAL
    ]
    if others:
        yield f"<dl>{''.join(others)}</dl>"
    yield "</section>"


def _content(title: str, content: _Json, document: _Json) -> Iterator[str]:
    for kind, media in content.items():
        yield f"<h4>{title}: <code>{escape(kind)}</code></h4>"
        example = _example(media, document)
        if example is not None:
            text = example if isinstance(example, str) else json.dumps(example, indent=1, ensure_ascii=False)
            yield f'<pre tabindex="0">{escape(text)}</pre>'


def _example(media: _Json, document: _Json) -> Any:
    if "example" in media:
        return media["example"]
    name = media.get("schema", {}).get("$ref", "").rpartition("/")[2]
    return next(iter(document["components"]["schemas"].get(name, {}).get("examples", [])), None)
