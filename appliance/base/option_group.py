"""Options that several verbs share: the parameters of one function."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import typer
from typer.core import TyperCommand, TyperOption

if TYPE_CHECKING:
    from typer._click import Command, Context, Parameter

T = TypeVar("T")


@dataclass(frozen=True)
class OptionGroup(Generic[T]):
    """Options that typer reads from the signature of a function."""

    function: Callable[..., T]

    @cached_property
    def _command(self) -> "Command":
        app = typer.Typer(add_completion=False)
        app.command()(self.function)
        return typer.main.get_command(app)

    @property
    def options(self) -> Sequence[TyperOption]:
        options = self._command.params
        assert all(isinstance(option, TyperOption) for option in options)  # noqa: S101  a group has no arguments
        return [option for option in options if isinstance(option, TyperOption)]

    def value(self, given: Mapping[str, object]) -> T:
        callback = self._command.callback
        assert callback is not None  # noqa: S101  typer gives each command one
        made: T = callback(**{name: given[name] for option in self.options if (name := option.name)})
        return made


class GroupedCommand(TyperCommand):
    """A command with the options of a group before and after its own."""

    def __init__(
        self,
        name: str | None = None,
        *,
        params: "Sequence[Parameter]" = (),
        before: "Sequence[Parameter]" = (),
        after: "Sequence[Parameter]" = (),
        **settings: Any,
    ) -> None:
        super().__init__(name, params=[*before, *params, *after], **settings)
        self._own = [param.name for param in params]

    def invoke(self, ctx: "Context") -> object:
        assert self.callback is not None  # noqa: S101  typer gives each verb one
        return ctx.invoke(self.callback, **{name: ctx.params[name] for name in self._own})


@dataclass(frozen=True)
class GroupedVerb:
    """Makes commands with a group of options; `command` is used like typer's decorator."""

    function: Callable[..., None]
    command: Callable[..., GroupedCommand]
