"""Print the output of all verbs: coloured on a terminal, plain in a pipe, JSON on request.

Text from the network is printed without control characters and never as markup.
"""

import errno
import os
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from mmap import mmap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, BinaryIO, TextIO, TypeVar

import msgspec
import typer
from typer.core import TyperOption

from appliance.api.front.moments import in_full
from appliance.base import actors
from appliance.base.atomic_files import NotLastingError, name_to_make, write_where_told
from appliance.base.timestamps import local_minute
from appliance.base.user_errors import with_remedy
from appliance.channel.answers.monitor_answers import Replaced
from rosmop.tool import terminal
from rosmop.tool.terminal import printable

if TYPE_CHECKING:
    from typer._click import Context

_T = TypeVar("_T")
_GAP, _INDENT = "  ", "    "
Json = Annotated[bool, typer.Option("--json", help="Machine-readable output, one object per line")]


# The value `-` of `--output`, in all verbs: the data alone goes to standard output, and what the verb says to standard
# error. A verb whose help does not offer it refuses it, and so does each other option with the name of a file.

STANDARD_OUTPUT = Path("-")
OR_STANDARD = "- for standard output"
_data: ContextVar[TextIO] = ContextVar("data")


def separate_data(context: "Context") -> None:
    """Prepare an option with the value `-`, or exit with a usage error."""
    for option in context.command.params:
        if not isinstance(option, TyperOption) or context.params.get(option.name or "") != STANDARD_OUTPUT:
            continue
        name = max(option.opts, key=len)
        verb = context.command_path.replace(str(context.find_root().info_name), "rosrv", 1)
        if OR_STANDARD not in (option.help or ""):
            raise usage_error(f"{name} - is not the name of a file: give one, such as {name} ./FILE", verb)
        if context.params.get("as_json"):
            raise usage_error(f"{name} - and --json both use standard output: give one", verb)
        if sys.stdout.isatty():
            raise usage_error(f"standard output is a terminal; redirect it: {name} - > FILE", verb)
        context.with_resource(_separated())


@contextmanager
def _separated() -> Iterator[None]:
    before = _data.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _data.reset(before)


def moment(seconds: float) -> str:
    return local_minute(seconds)


def loaded_by(who: str, seconds: float | None) -> str:
    match who:
        case actors.DISK:
            how = "read from disk"
        case actors.UNCONFIRMED:
            how = f"rolled back automatically ({who})"
        case _:
            how = f"loaded by {who}"
    return how if seconds is None else f"{how} {moment(seconds)}"


def usage_error(text: str, verb: str = "rosrv") -> typer.Exit:
    typer.echo(f"{verb}: {printable(text)}", err=True)
    return typer.Exit(2)


def refuse_beside_dry_run(verb: str, **given: object) -> None:
    """Exit with a usage error if an option is given that changes nothing in a dry run."""
    for name, value in given.items():
        if value:
            option = f"--{name.replace('_', '-')}"
            raise usage_error(f"{option} has no effect with --dry-run: leave one of them out", verb)


def write_told(path: Path, data: bytes | mmap) -> None:
    """Write a file, and warn if a power cut may lose the data. Raises `OSError`."""
    if path == STANDARD_OUTPUT:
        with new_file(path) as file:
            file.write(data)
        return
    try:
        write_where_told(path, data)
    except NotLastingError as error:
        typer.echo(f"rosrv: {printable(str(path))}: {error.strerror}", err=True)


def write_new(file: Path, text: str, *, verb: str) -> None:
    """Write a file that must not exist; otherwise exit with a usage error."""
    try:
        with new_file(file, 0o644) as made:
            made.write(text.encode())
    except OSError as error:
        raise usage_error(f"cannot write {with_remedy(error, file)}", verb=verb) from error


@contextmanager
def new_file(path: Path, mode: int = 0o600) -> Iterator[BinaryIO]:
    """Make a file that must not exist; it gets its name when it is whole. Raises `OSError` with this name.

    `STANDARD_OUTPUT` stands for standard output, to which the block writes directly.
    """
    if path == STANDARD_OUTPUT:
        stream = _data.get(sys.stdout)
        stream.flush()
        yield stream.buffer
        stream.buffer.flush()
        return
    if os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    part = name_to_make(path)
    try:
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        with os.fdopen(descriptor, "wb") as file:
            yield file
        part.rename(path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(part), part):  # such as a full disk
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def say_json(fields: msgspec.Struct | Mapping[str, object] | tuple[object, ...]) -> None:
    terminal.say_json(in_full(fields.in_lines() if isinstance(fields, Replaced) else fields))


def say_diff(lines: Iterable[str]) -> None:
    for line in lines:
        terminal.say(line, {"+": "green", "-": "red", "@": "cyan"}.get(line[:1], ""))


def by_host(rows: Iterable[_T], host: Callable[[_T], str]) -> list[tuple[str, list[_T]]]:
    found: dict[str, list[_T]] = {}
    for row in rows:
        found.setdefault(host(row), []).append(row)
    return sorted(found.items(), key=lambda item: -len(item[1]))


def say_row(parts: Iterable[str], style: str = "", gap: str = _GAP) -> None:
    """Write the parts of a row as one line; a narrow terminal gets line breaks, if possible between two parts."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    for line in row_lines(map(printable, parts), width, gap):
        terminal.say(line, style)


def row_lines(parts: Iterable[str], width: int | None, gap: str = _GAP) -> list[str]:
    """Return the lines of a row. A line is longer than `width` only if it is one word, such as a name to copy."""
    first, *rest = parts
    lines = [first]
    for part in rest:
        if width is None or len(lines[-1]) + len(gap) + len(part.rstrip()) <= width:
            lines[-1] += gap + part
        else:
            lines.append(_INDENT + part)
    if width is None:
        return lines
    return [
        folded for number, line in enumerate(lines) for folded in _fold(line.rstrip(), width, bool(number))
    ]


def _fold(line: str, width: int, indented: bool) -> list[str]:
    if len(line) <= width:
        return [line]
    return textwrap.wrap(
        line.strip() if indented else line,
        max(width, 2 * len(_INDENT)),
        initial_indent=_INDENT if indented else "",
        subsequent_indent=_INDENT,
        break_long_words=False,
        break_on_hyphens=False,
    )
