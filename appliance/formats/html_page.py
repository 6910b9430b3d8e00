"""Make self-contained HTML pages without scripts; everything that is not ours is escaped."""

import html
from collections.abc import Iterable, Iterator, Sequence

from appliance.audit.log.record_format import printable

_HEAD = """\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 75rem; padding: 0 1rem;
  color-scheme: light dark }}
table {{ border-collapse: collapse; width: 100% }}
td, th {{ text-align: left; vertical-align: top; padding: .15rem .6rem .15rem 0 }}
tr {{ border-top: 1px solid #8884; break-inside: avoid }}
td {{ overflow-wrap: anywhere }}
td.number {{ text-align: right; white-space: nowrap }}
pre, code, .time {{ font-family: ui-monospace, monospace }}
.time, .unbroken {{ white-space: nowrap }}
pre {{ overflow-x: auto; white-space: pre-wrap; border: 1px solid #8884; padding: .6rem }}
.warning, .deny {{ color: #b50 }}
.alarm {{ color: #d00; font-weight: 600 }}
@page {{ margin: 14mm; @bottom-right {{ content: counter(page) " of " counter(pages); font-size: 9px }} }}
@media print {{ body {{ font-size: 10px; margin: 0; max-width: none; padding: 0 }} h2, p {{ break-after: avoid }} }}
</style>
"""

Cells = Sequence[object]


class Unbroken(str):
    """A cell that stays on one line, such as a time or an address."""

    __slots__ = ()


def head(title: str) -> str:
    return _HEAD.format(title=text(title))


def text(words: str) -> str:
    return html.escape(printable(words).encode("utf-8", "replace").decode())


def lines(words: str) -> str:
    return "\n".join(map(text, words.split("\n")))


def section(title: str, columns: Sequence[str], rows: Iterable[Cells], empty: str = "") -> Iterator[str]:
    """Yield a heading with a table. Without rows, yield `empty` below the heading, or nothing if it is empty."""
    table = list(rows)
    if not table:
        if empty:
            yield f"<h2>{text(title)}</h2>\n<p>{text(empty)}</p>\n"
        return
    yield f"<h2>{text(title)}</h2>\n<table>\n"
    if columns:  # repeated on each page of paper
        yield f"<thead><tr>{''.join(f'<th>{column}' for column in columns)}</thead>\n"
    for row in table:
        yield f"<tr>{''.join(map(_cell, row))}\n"
    yield "</table>\n"


def _cell(cell: object) -> str:
    if isinstance(cell, int | float):
        return f'<td class="number">{cell:,}'
    kind = ' class="unbroken"' if isinstance(cell, Unbroken) else ""
    return f"<td{kind}>{text(str(cell))}"
