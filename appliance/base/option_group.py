"""Options that several verbs share: the parameters of one function."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

import typer
from typer.core import TyperCommand

T = TypeVar("T")


@dataclass(frozen=True)
class OptionGroup(Generic[T]):
    """Options that typer reads from the signature of a function."""

    function: Callable[..., T]

    @cached_property
    def _command(self) -> Any:
        app = typer.Typer(add_completion=False)
        app.command()(self.function)
        return typer.main.get_command(app)

    @property
    def options(self) -> Sequence[Any]:
        return tuple(self._command.params)

    def value(self, given: Mapping[str, Any]) -> T:
        made: T = self._command.callback(**{option.name: given[option.name] for option in self.options})
        return made


class GroupedCommand(TyperCommand):
    """A command with the options of a group before and after its own."""

    def __init__(
        self,
        *args: Any,
        params: Sequence[Any] = (),
        before: Sequence[Any] = (),
        after: Sequence[Any] = (),
        **settings: Any,
    ) -> None:
        super().__init__(*args, params=[*before, *params, *after], **settings)
        self._own = [one.name for one in params]

    def invoke(self, ctx: Any) -> Any:
        assert self.callback is not None  # noqa: S101  typer gives each verb one
        return ctx.invoke(self.callback, **{name: ctx.params[name] for name in self._own})


@dataclass(frozen=True)
class GroupedVerb:
    """Makes commands with a group of options; `command` is used like typer's decorator."""

    function: Callable[..., None]
    command: Callable[..., GroupedCommand]
