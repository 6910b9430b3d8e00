"""Generate docs/reference/generated/command-line.md."""

import re
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

import typer

from appliance.cli.main import app
from rosmop.tool.command import app as rosmop_app

_HEAD = """# The command line

`-h` after any command prints its text and all its options; the Debian package also has man pages. The exit status is 0
for success, 1 for a failure or a finding, and 2 for a wrong command line, unless the command's text says otherwise.
Give arguments in the order of their table: `{{X}}` is required, `[X]` is not.

Each command takes {usual}, except those that follow *Not*.

## Options of many commands

"""
_SHARED_BY = 4  # the minimum number of commands that share an option
_REPEATED = 3  # the minimum number of further options that refer to an earlier command


class _Command(NamedTuple):
    title: str = ""
    help: str = ""
    options: tuple[tuple[str, str], ...] = ()


def page() -> str:
    """Return the page: options that many commands share, then each command."""
    found = [*_commands("rosrv", app), *_commands("rosmop", rosmop_app)]
    uses = Counter(option for one in found for option in one.options)
    often = [one for one, number in uses.most_common() if number >= _SHARED_BY and one[0].startswith("-")]
    shared = sorted({flags: (flags, text) for flags, text in reversed(often)}.values())  # the most used text
    usual = [_name(one[0]) for one in shared if len(found) / 2 < uses[one] < len(found)]
    sections = (_section(one, found[:place], set(shared), usual) for place, one in enumerate(found))
    return _HEAD.format(usual=_names(usual)) + _table(shared) + "".join(sections)


def _section(one: _Command, before: list[_Command], shared: set[tuple[str, str]], usual: list[str]) -> str:
    same = re.sub(r"\brosmop\b", "rosrv monitor", one.help)
    if like := [other.title for other in before if other.help == same]:
        return f"\n## {one.title}\n\nThe same as {_link(like[0])}.\n"
    own = [option for option in one.options if option not in shared]
    near = max(before, key=lambda other: len({*own} & {*other.options}), default=_Command())
    again = [option for option in own if option in near.options and option[0].startswith("-")]
    left = [option for option in own if option not in again or len(again) < _REPEATED]
    names = {_name(flags) for flags, _ in one.options}
    common = {_name(flags) for flags, _ in shared.intersection(one.options)}.difference(usual, ["-h"])
    example = rf"\n\nExample: `{re.escape(one.title)}( [^- ][^ ]*)?`$"  # without options
    text = f"\n## {one.title}\n\n{re.sub(example, '', one.help)}\n"
    text += f"\n{_table(left)}" if left else ""
    lists = (
        (f"As in {_link(near.title)}: ", [_name(option[0]) for option in again if option not in left]),
        ("Also ", sorted(common)),
        ("Not ", [name for name in usual if name not in names]),
    )
    ends = [f"{word}{_names(found)}." for word, found in lists if found]
    return text + (f"\n{' '.join(ends)}\n" if ends else "")


def _link(title: str) -> str:
    return f"[`{title}`](#{title.replace(' ', '-')})"


def _names(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _table(options: list[tuple[str, str]]) -> str:
    if len(options) == 1:
        return f"`{options[0][0]}`: {options[0][1]}.\n"
    cells = ((flags.replace("|", r"\|"), text.replace("|", r"\|")) for flags, text in options)
    return "| option | effect |\n|---|---|\n" + "".join(f"| `{flags}` | {text} |\n" for flags, text in cells)


def _name(flags: str) -> str:
    return re.split(r"[ ,]", flags)[0]


def _commands(name: str, application: typer.Typer) -> Iterator[_Command]:
    for words, command, context in commands((name,), application):
        if not hasattr(command, "list_commands"):
            records = [param.get_help_record(context) for param in command.get_params(context)]
            texts = [(record[0], " ".join(record[1].split())) for record in records if record]
            usage = command.collect_usage_pieces(context)[1:]  # the arguments, which come first
            effects = [text.removesuffix(" [required]") for _, text in texts[: len(usage)]]
            options = (*zip(usage, effects, strict=True), *texts[len(usage) :])
            yield _Command(" ".join(words), _markdown(command.help or ""), options)


def commands(words: tuple[str, ...], application: typer.Typer) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Yield a program and its visible commands: the words, the command, and its context."""
    root = typer.main.get_command(application)
    yield from _below(words, root, root.make_context(words[0], [], resilient_parsing=True))


def _below(words: tuple[str, ...], command: Any, context: Any) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    yield words, command, context
    for name in command.list_commands(context) if hasattr(command, "list_commands") else ():
        inner = command.get_command(context, name)
        if not inner.hidden:
            below = inner.make_context(name, [], parent=context, resilient_parsing=True)
            yield from _below((*words, name), below.command, below)


def _markdown(text: str) -> str:
    paragraphs = (
        _code(one) if one.startswith("\b\n") else " ".join(one.split()) for one in text.strip().split("\n\n")
    )
    return "\n\n".join(re.sub(r"^(Examples?): (.*)", r"\1: `\2`", paragraph) for paragraph in paragraphs)


def _code(paragraph: str) -> str:
    return f"```text\n{paragraph.removeprefix(chr(8)).strip()}\n```"
