"""Make typer commands that import their modules only when they run.

Importing all modules takes a second of processor time, so `rosrv status` must not import the compiler. `--help` and
completion take the verbs' names from the table of verbs, and the first sentences of help from the source files.
"""

import importlib
import inspect
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from appliance.base.option_group import GroupedVerb
from appliance.base.validation_messages import refusal
from appliance.base.verbs import Group, Verb, Verbs


def application(verbs: Verbs, *, callback: Callable[..., None] | None = None, **settings: Any) -> typer.Typer:
    """Return a typer application with these verbs; `callback` takes the options before the verb."""
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


def _group_of(verbs: Verbs) -> type[TyperGroup]:
    class _Lazy(TyperGroup):
        """A group whose commands are imported when they are run."""

        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            self.commands = {name: _command_of(verb, name) for name, verb in verbs.items()}

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            """Return the verb. For an unknown name without a close match, list all verbs."""
            name = args[0]
            if name not in self.commands and name[:1] != "-" and not get_close_matches(name, self.commands):
                shown = [verb for verb, command in self.commands.items() if not command.hidden]
                ctx.fail(f"No such command {name!r}; use one of: {', '.join(shown)}.")
            return super().resolve_command(ctx, args)

    return _Lazy


def _command_of(verb: Verb | Group, name: str) -> Any:
    match verb:
        case Group(help, inner):
            return _named(typer.main.get_group(application(inner, help=help)), name)
        case Verb():
            return _Deferred(verb, name)


def _named(command: Any, name: str) -> Any:
    command.name = name
    return command


class _Deferred(TyperCommand):
    """A verb that is not imported yet."""

    help = property(lambda self: self._verb.help, lambda _self, _given: None)  # click sets it

    def __init__(self, verb: Verb, name: str) -> None:
        super().__init__(name, hidden=verb.hidden)
        self._verb = verb

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        command = loaded(self._verb, str(self.name))
        try:
            return command.make_context(info_name, args, parent, **extra)
        except typer.BadParameter as error:
            from pydantic import ValidationError  # noqa: PLC0415  a correct command line does not need it

            if isinstance(error.__cause__, ValidationError):  # typer chains it
                error.message = refusal(error.__cause__.errors()[0])
            raise


def loaded(verb: Verb, name: str) -> Any:
    """Import a verb and return its command."""
    found = getattr(importlib.import_module(verb.module), verb.function)
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    function, kind = (
        (found.function, found.command) if isinstance(found, GroupedVerb) else (found, TyperCommand)
    )
    words = "\n\n".join(filter(None, (verb.first, inspect.getdoc(function))))
    app.command(name, cls=kind, help=words)(function)  # type: ignore[arg-type]  # typer only calls `cls`
    return typer.main.get_command(app)
