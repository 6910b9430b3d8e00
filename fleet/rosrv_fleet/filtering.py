"""Give the search the options of `rosrv audit search`."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

from appliance.audit.search.filter_options import filter_given


def searched(verb: Callable[..., None]) -> Callable[..., None]:
    """Replace a verb's first parameter, a `Filter`, by the options of `rosrv audit search`."""
    options = inspect.signature(filter_given, eval_str=True).parameters

    @functools.wraps(verb)
    def with_filter(**given: Any) -> None:
        verb(filter_given(**{name: given.pop(name) for name in options}), **given)

    own = inspect.signature(verb, eval_str=True)
    _wanted, *rest = own.parameters.values()
    named = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in rest]
    with_filter.__signature__ = own.replace(parameters=[*options.values(), *named])  # type: ignore[attr-defined]  # what typer reads
    return with_filter
