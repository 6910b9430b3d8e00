"""The frame of each page of the console, and its elements.

Functions escape the strings that they get, except `body`, `rows`, `cells`, and labels that are constants.
"""

from collections.abc import Iterable, Sequence
from html import escape
from typing import Literal, NamedTuple
from urllib.parse import urlencode

from fastapi.responses import HTMLResponse

from appliance.audit.log.record_format import printable
from appliance.base import clock
from appliance.base.timestamps import local_text
from rosrv_fleet.tokens import OperatorToken

# With `no-referrer`, browsers send `Origin: null` with the console's own forms.
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'self'; form-action 'self'; frame-ancestors 'none';"
    " base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_PAGES = (("/", "Robots"), ("/rollouts", "Rollouts"), ("/search", "Search"), ("/evidence", "Evidence"))
Tone = Literal["good", "bad", "warn", "plain"]


class Column(NamedTuple):
    """A column of a table. A number is aligned to the right."""

    name: str
    number: bool = False


def page(title: str, body: str, holder: OperatorToken | None, status: int = 200) -> HTMLResponse:
    head = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{escape(title)} - ROSRV fleet</title>"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<link rel="stylesheet" href="/console.css"></head><body>'
    )
    bar = "" if holder is None else _bar(title, holder)
    return HTMLResponse(f"{head}{bar}<main>{body}</main></body></html>", status, HEADERS)


def _bar(title: str, holder: OperatorToken) -> str:
    links = "".join(
        f'<a href="{path}"{_CURRENT if title.startswith(name) else ""}>{name}</a>' for path, name in _PAGES
    )
    return (
        f'<header><strong>ROSRV fleet</strong><nav aria-label="Pages">{links}</nav>'
        f'<form method="post" action="/logout"><span>{escape(holder.name)} ({holder.role})</span>'
        '<button class="plain">Log out</button></form></header>'
    )


_CURRENT = ' aria-current="page"'


def text(value: object) -> str:
    return escape(printable(str(value)))


def alert(reason: str) -> str:
    return f'<p class="alert">{text(reason)}</p>'


def badge(tone: Tone, word: str) -> str:
    return f'<span class="badge {tone}">{text(word)}</span>'


def table(caption: str, columns: Sequence[Column], rows: Iterable[str], empty: str) -> str:
    body = "".join(rows)
    if not body:
        return f'<section><h2>{text(caption)}</h2><p class="muted">{text(empty)}</p></section>'
    heads = "".join(
        f'<th scope="col"{_NUMBER if column.number else ""}>{column.name}</th>' for column in columns
    )
    return (
        f'<div class="wide" role="region" aria-label="{text(caption)}" tabindex="0"><table>'
        f"<caption>{text(caption)}</caption><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>"
    )


_NUMBER = ' class="number"'


def row(columns: Sequence[Column], cells: Sequence[str]) -> str:
    first, *others = zip(columns, cells, strict=True)
    return (
        f'<tr><th scope="row">{first[1]}</th>'
        + "".join(f"<td{_NUMBER if column.number else ''}>{cell}</td>" for column, cell in others)
        + "</tr>"
    )


def link(path: str, label: str, **parameters: str) -> str:
    """Return a link with the parameters that are not empty."""
    given = {name: value for name, value in parameters.items() if value}
    return f'<a href="{escape(path + ("?" + urlencode(given) if given else ""))}">{text(label)}</a>'


def choice(name: str, label: str, options: Iterable[tuple[str, str]], chosen: str) -> str:
    items = "".join(
        f'<option value="{escape(value)}"{" selected" if value == chosen else ""}>{text(shown)}</option>'
        for value, shown in options
    )
    return f'<label>{label} <select name="{name}">{items}</select></label>'


def field(name: str, value: str) -> str:
    return f'<label>{name} <input name="{name}" value="{escape(value)}" maxlength="256"></label>'


def ago(seconds: float) -> str:
    for unit, size in (("d", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit} ago"
    return f"{max(seconds, 0):.0f} s ago"


def since(at: float) -> str:
    return ago(clock.wall() - at)


def moment(at: float) -> str:
    """Return seconds since the epoch as a time in the collector's zone, with its offset."""
    return local_time(int(at) * 10**9)


def local_time(time: int, digits: int = 0) -> str:
    """Return nanoseconds since the epoch in the collector's zone, with its offset; the search takes this text."""
    return local_text(time, digits=digits).replace("T", " ")
