import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

T = TypeVar("T")


def idle(part: type[T], **attributes: Any) -> T:
    made = idle_class(part)()
    vars(made).update(attributes)
    return cast(T, made)


def idle_class(part: type[object]) -> Any:
    """Return a class with the public methods of `part`, which only check their arguments against the signature.

    So a renaming in the product fails in its tests. An object of the class has no attributes.
    """
    methods = {
        name: _idle(method)
        for name, method in inspect.getmembers(part, inspect.isfunction)
        if not name.startswith("_")
    }
    return type(f"Idle{part.__name__}", (part,), methods | {"__init__": lambda _self: None})


def _idle(method: Callable[..., Any]) -> Callable[..., None]:
    signature = inspect.signature(method)

    @functools.wraps(method)
    def checked(*given: Any, **named: Any) -> None:
        signature.bind(*given, **named)

    return checked
