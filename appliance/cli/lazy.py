"""Verbs whose modules are imported when they are run, not when the command starts.

`rosrv status` must not wait for the compiler of specifications, nor for a network library that one other verb needs.
What `--help` and completion list is known without importing anything: names stand in a table, the first sentences in
the files of the verbs.
"""

import functools
import importlib
import inspect
import os.path
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from appliance.base.validation_messages import refusal


@dataclass(frozen=True, slots=True)
class Verb:
    """Where a verb is in this folder (`module:function`); the first sentence of its help, if its docstring lacks it."""

    place: str
    first: str = ""
    hidden: bool = False

    @property
    def help(self) -> str:
        """The first sentence; a docstring is read without importing its module."""
        module, _colon, function = self.place.partition(":")
        file = _FOLDER.joinpath(*module.split(".")).with_suffix(".py")
        return self.first or _first_sentence(file, function)


Verbs = Mapping[str, "Verb | Group"]
_FOLDER = Path(__file__).parent


@functools.cache
def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8")


def _first_sentence(file: Path, function: str) -> str:
    found = re.search(rf'(?ms)^def {function}\(.*?"""(.+?)(?:"""|\n\n)', _text(file))
    assert found is not None, function  # noqa: S101  every verb has a docstring
    return " ".join(found[1].split())


@dataclass(frozen=True, slots=True)
class Group:
    """Verbs of several modules with a first word in common."""

    help: str
    verbs: Mapping[str, Verb]


def application(verbs: Verbs, *, callback: Callable[..., None] | None = None, **settings: Any) -> typer.Typer:
    """An application of typer's with these verbs; `callback` has the options that stand before a verb."""
    app = typer.Typer(
        cls=_group_of(verbs),
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        **settings,
    )
    app.callback()(callback or _nothing)
    return app


def _nothing() -> None:
    pass


class _Reader:
    """Reads one flag or argument as typer does, which has pydantic say that a text is a text and a path is a path.

    Those, and what is not given, are read without: loading pydantic would be half of the time of a short command.
    """

    def __init__(self, parameter: Any) -> None:
        self._parameter = parameter
        self._typers = parameter.get_runtime_param

    def itself(self) -> "_Reader":
        """As typer asks for it."""
        return self

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """The value that the verb is given. Raises `typer.BadParameter`."""
        kind = self._parameter.type_descriptor.annotation
        if value is None:
            return () if param.multiple or param.nargs == -1 else None
        plain = isinstance(value, str | Path) and str(value).isascii()
        if kind is Path and plain and not self._looks_at(Path(value)):
            return Path(value)
        if (kind is str and plain) or (kind in (int, float, str) and value is param.default):
            return value
        return self._typers().coerce(value, param=param, ctx=ctx)

    def _looks_at(self, path: Path) -> bool:
        """Whether typer might refuse this path, or change it."""
        info = self._parameter.type_descriptor.parameter_info
        if info.exists or info.writable or info.resolve_path or not (info.file_okay and info.dir_okay):
            return True
        return info.readable and os.path.exists(path) and not os.access(path, os.R_OK)  # noqa: PTH110  no error


class _Sparing:
    """A command whose flags and arguments are read by `_Reader`."""

    def get_params(self, ctx: Any) -> Any:
        """All of them, `--help` included."""
        found = super().get_params(ctx)  # type: ignore[misc]  # the class beside it has them
        for parameter in found:
            if parameter.get_runtime_param.__name__ != "itself":
                parameter.get_runtime_param = _Reader(parameter).itself
        return found


class _Command(_Sparing, TyperCommand):
    pass


def _group_of(verbs: Verbs) -> type[TyperGroup]:
    class _Lazy(_Sparing, TyperGroup):
        """A group whose commands are imported when they are run."""

        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            self.commands = {name: _command_of(verb, name) for name, verb in verbs.items()}

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            """The verb; one that is none and near to none is told which there are."""
            name = args[0]
            if name not in self.commands and name[:1] != "-" and not get_close_matches(name, self.commands):
                shown = [verb for verb, command in self.commands.items() if not command.hidden]
                ctx.fail(f"No such command {name!r}; there are: {', '.join(shown)}.")
            return super().resolve_command(ctx, args)

    return _Lazy


def _command_of(verb: "Verb | Group", name: str) -> Any:
    match verb:
        case Group(help, inner):
            return _named(typer.main.get_group(application(inner, help=help)), name)
        case Verb():
            return _Deferred(verb, name)


def _named(command: Any, name: str) -> Any:
    command.name = name
    return command


class _Deferred(TyperCommand):
    """A verb that is not imported yet; its help is looked up when somebody wants to see it."""

    help = property(lambda self: self._verb.help, lambda _self, _given: None)  # click sets it

    def __init__(self, verb: Verb, name: str) -> None:
        super().__init__(name, hidden=verb.hidden)
        self._verb = verb

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """It is run, or completed: from here on it is the real one."""
        command = loaded(self._verb, str(self.name))
        try:
            return command.make_context(info_name, args, parent, **extra)
        except typer.BadParameter as error:
            # Of pydantic, which is not imported for this.
            wrong: list[dict[str, Any]] = getattr(error.__cause__, "errors", list)()
            if wrong:
                error.message = refusal(wrong[0])
            raise


def loaded(verb: Verb, name: str) -> Any:
    """The real command of a verb."""
    module, _colon, attribute = verb.place.partition(":")
    found = getattr(importlib.import_module(f"appliance.cli.{module}"), attribute)
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command(name, cls=_Command, help="\n\n".join(filter(None, (verb.first, inspect.getdoc(found)))))(
        found
    )
    return typer.main.get_command(app)
