"""Make typer commands that import their modules only when they run: all modules together take a second."""

import functools
import inspect
import pkgutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup, TyperOption

from appliance.base.option_group import GroupedVerb
from appliance.base.validation_messages import refusal
from appliance.cli.verb_table import Group, Verb, Verbs, merge
from rosmop.tool.terminal import reflow

if TYPE_CHECKING:
    from typer._click import Command, Context, Parameter


# The panels of `rosrv --help`, in their order.

PANELS: dict[str, tuple[str, ...]] = {
    "Begin": ("demo", "survey", "up", "adopt", "release", "status", "selftest", "version"),
    "Drive and stop": ("guard", "drive", "approve", "approval", "door"),
    "Decide who may do what": ("policy", "host", "protect", "sign"),
    "Watch the robot": ("topic", "node", "monitor", "record"),
    "Review": ("audit", "who-drove", "report", "evidence", "alarm", "limits"),
    "Let people and programs in": ("token", "sso", "certificate"),
    "Operate": ("config", "backup", "restore", "purge", "standby", "fleet"),
}
_FURTHER = "Further commands"


def panel_of(name: str) -> str:
    return next((panel for panel, names in PANELS.items() if name in names), _FURTHER)


def in_order(names: Iterable[str]) -> list[str]:
    """Return the names in the order of the panels; those without one are last, as they are."""
    known = [name for names_of in PANELS.values() for name in names_of]
    return sorted(names, key=lambda name: known.index(name) if name in known else len(known))


_HELP_OPTIONS = ["-h", "--help"]
_FOLDERS = ("--state", "--monitors", "--other")
_METAVARS = {
    **dict.fromkeys(("--since", "--until", "--at"), "TIME"),
    **dict.fromkeys(
        ("--for", "--within", "--confirm-within", "--before", "--after", "--every", "--grace"), "DURATION"
    ),
    **dict.fromkeys(("--other", "--witness", "--fixed"), "ADDRESS"),
    "--listen": "HOST:PORT",
    "--note": "TEXT",
    "--ports": "FIRST-LAST",
}


def application(
    verbs: Verbs,
    *,
    further: Callable[[], Iterable[Verbs]] = tuple,
    callback: Callable[..., None] | None = None,
    panels: bool = False,
    summary: str,
    name: str | None = None,
) -> typer.Typer:
    """Return an application; `further` returns more verbs, for help, completion and a name that `verbs` lacks.

    `panels`: the help lists the commands in the panels of `PANELS`.
    """
    app = typer.Typer(
        cls=_group_of(verbs, further, panels=panels),
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": _HELP_OPTIONS},
        help=summary,
        name=name,
    )
    app.callback()(callback or _nothing)
    return app


def _nothing() -> None:
    pass


def _group_of(verbs: Verbs, further: Callable[[], Iterable[Verbs]], *, panels: bool) -> type[TyperGroup]:
    class _Lazy(TyperGroup):
        # click sets it
        commands = property(lambda self: self.all_commands, lambda _self, _given: None)

        @functools.cached_property
        def own_commands(self) -> dict[str, TyperCommand | TyperGroup]:
            return {name: _command_of(verb, name, further) for name, verb in verbs.items()}

        @functools.cached_property
        def all_commands(self) -> dict[str, TyperCommand | TyperGroup]:
            own, table = self.own_commands, merge(verbs, *further())
            commands = {name: own.get(name) or _command_of(verb, name, tuple) for name, verb in table.items()}
            if not panels:
                return commands
            for name, command in commands.items():
                command.rich_help_panel = panel_of(name)
            return {name: commands[name] for name in in_order(commands)}

        def get_params(self, ctx: "Context") -> "list[Parameter]":
            return _without_type_of_flags(super().get_params(ctx))

        def get_command(self, ctx: "Context", cmd_name: str) -> "Command | None":
            return self.own_commands.get(cmd_name) or super().get_command(ctx, cmd_name)

        def resolve_command(
            self, ctx: "Context", args: list[str]
        ) -> "tuple[str | None, Command | None, list[str]]":
            known = args[0] in self.own_commands or args[0][:1] == "-" or args[0] in self.commands
            if not known and not ctx.resilient_parsing:
                raise _unknown(args[0], ctx, merge(verbs, *further()))
            return super().resolve_command(ctx, args)

    return _Lazy


def _unknown(word: str, ctx: "Context", verbs: Verbs) -> typer.Exit:
    from appliance.cli.meanings import answer_to  # noqa: PLC0415  a correct command line does not need it
    from appliance.cli.output import usage_error  # noqa: PLC0415  as above

    groups: list[str] = []
    while ctx.parent is not None:
        groups.insert(0, str(ctx.info_name))
        ctx = ctx.parent
    return usage_error(answer_to(word, " ".join(groups), verbs))


def _command_of(
    verb: Verb | Group, name: str, further: Callable[[], Iterable[Verbs]]
) -> TyperCommand | TyperGroup:
    match verb:
        case Group(help, inner):
            more = functools.partial(_inner, further, name)
            return _named(typer.main.get_group(application(inner, further=more, summary=help)), name)
        case Verb():
            return _Deferred(verb, name)


def _inner(further: Callable[[], Iterable[Verbs]], name: str) -> list[Verbs]:
    groups = (verbs.get(name) for verbs in further())
    return [group.verbs for group in groups if isinstance(group, Group)]


def _named(command: TyperGroup, name: str) -> TyperGroup:
    command.name = name
    return command


class _Deferred(TyperCommand):
    help = property(lambda self: self._verb.help, lambda _self, _given: None)  # click sets it

    def __init__(self, verb: Verb, name: str) -> None:
        super().__init__(name, hidden=verb.hidden)
        self._verb = verb

    def make_context(
        self, info_name: str | None, args: list[str], parent: "Context | None" = None, **extra: object
    ) -> "Context":
        command = load_command(self._verb, str(self.name))
        try:
            context = command.make_context(info_name, args, parent, **extra)
        except typer.BadParameter as error:
            from pydantic import ValidationError  # noqa: PLC0415  a correct command line does not need it

            if isinstance(error.__cause__, ValidationError):  # typer chains it
                error.message = refusal(error.__cause__.errors()[0])
            raise
        if Path("-") in context.params.values():
            from appliance.cli.output import separate_data  # noqa: PLC0415  as above

            separate_data(context)
        return context


def load_command(verb: Verb, name: str) -> "Command":
    found = pkgutil.resolve_name(verb.path)
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    function, kind = (
        (found.function, found.command) if isinstance(found, GroupedVerb) else (found, TyperCommand)
    )
    words = reflow("\n\n".join(filter(None, (verb.first, inspect.getdoc(function)))))
    app.command(name, cls=kind, help=words)(function)  # type: ignore[arg-type]  # typer only calls `cls`
    command = typer.main.get_command(app)
    # click keeps the help option of the first context that asks for it
    context = typer.Context(command, info_name=name, help_option_names=_HELP_OPTIONS)
    for option in _without_type_of_flags(command.get_params(context)):
        if isinstance(option, TyperOption) and option.metavar is None:
            option.metavar = _metavar(option, option.display_type(context) or "")
        elif isinstance(option, TyperArgument):
            option.metavar = option.metavar or (option.name or "").upper()
            option.display_type_rich = _no_type  # type: ignore[method-assign]  # typer has no option for it
    return command


def _no_type(ctx: "Context") -> None:
    """Leave out the type of an argument, such as `<list[str]>`: the help says what it is."""


def _metavar(option: TyperOption, kind: str) -> str | None:
    """Return the word for an option's value, one for each kind of value; None keeps typer's."""
    name = next(opt for opt in option.opts if opt.startswith("--"))
    if name in _METAVARS and kind == "<str>":
        return _METAVARS[name]
    words = {
        "<path>": "DIR" if name in _FOLDERS else "FILE",
        "<str>": name.lstrip("-").upper(),
        "<int>": "N",
        "<int range>": "N",
    }
    return words.get(kind.replace("list[", "").replace("]", ""))


def _without_type_of_flags(options: "list[Parameter]") -> "list[Parameter]":
    for option in options:
        if isinstance(option, TyperOption) and option.is_flag:
            option.metavar = ""
    return options
