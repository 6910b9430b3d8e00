"""Write the man pages of `rosrv` from its own help: rosrv(1), and a page for each command.

    python -m distribution.man DIRECTORY DATE

DATE has the form 2026-11-01. It is an argument so that two builds write the same pages.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from appliance import __version__ as VERSION  # noqa: N812  a constant
from appliance.cli.main import app
from distribution.command_line_page import commands

_FILES = """\
.SH FILES
.TP
.I /etc/rosrv/appliance.yaml
The configuration; \\fBrosrv config show\\fR prints every setting.
.TP
.I /etc/rosrv/policies, /etc/rosrv/monitors, /etc/rosrv/ipsec/hosts.yaml
Files that an operator edits.
.TP
.I /var/lib/rosrv
The state: registrations, audit log, keys.
.SH SEE ALSO
The pages in \\fI/usr/share/doc/rosrv\\fR.
"""


def write_pages(directory: Path, date: str) -> None:
    directory.mkdir(parents=True, exist_ok=True)
    for words, command, context in commands(("rosrv",), app):
        text = "".join(_page(" ".join(words), command, context, date))
        (directory / f"{'-'.join(words)}.1").write_text(text + (_FILES if len(words) == 1 else ""))


def _page(title: str, command: Any, context: Any, date: str) -> Iterator[str]:
    name = title.replace(" ", "-")
    summary, _, rest = (command.help or "").strip().partition("\n\n")
    yield f'.TH "{name.upper()}" 1 "{date}" "rosrv {VERSION}" "ROSRV appliance"\n'
    yield f".SH NAME\n{_text(name)} \\- {_text(_one_line(summary).rstrip('.'))}\n"
    pieces = " ".join(_text(piece) for piece in command.collect_usage_pieces(context))
    yield f".SH SYNOPSIS\n.B {_text(title)}\n{pieces}\n"
    if rest:
        yield ".SH DESCRIPTION\n"
        for paragraph in rest.split("\n\n"):
            yield f".PP\n{_paragraph(paragraph)}\n"
    if hasattr(command, "list_commands"):
        yield ".SH COMMANDS\n"
        for verb in command.list_commands(context):
            inner = command.get_command(context, verb)
            if not inner.hidden:
                yield f".TP\n.B {_text(verb)}\n{_text(inner.get_short_help_str(300))}\n"
    options = [record for record in _records(command, context) if record]
    if options:
        yield ".SH OPTIONS\n"
        for flags, help_text in options:
            yield f".TP\n.B {_text(flags)}\n{_text(_one_line(help_text)) or '.br'}\n"


def _records(command: Any, context: Any) -> Iterator[tuple[str, str] | None]:
    for parameter in command.get_params(context):
        yield parameter.get_help_record(context)


def _paragraph(text: str) -> str:
    """Return a paragraph for troff; one of commands (`\\b`) keeps its lines."""
    return f".nf\n{_text(text[2:])}\n.fi" if text.startswith("\b\n") else _text(_one_line(text))


def _one_line(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()


def _text(text: str) -> str:
    escaped = text.replace("\\", "\\e").replace("-", "\\-").replace("'", "\\(aq")
    return re.sub(r"^\.", r"\\&.", escaped, flags=re.MULTILINE)


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]), sys.argv[2])
