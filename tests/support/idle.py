import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

T = TypeVar("T")
_NO_CODE = (lambda: None).__code__  # of methods in C


def idle(part: type[T], **attributes: Any) -> T:
    made = idle_class(part)()
    replace(made, **attributes)
    return cast(T, made)


def replace(part: object, **attributes: Any) -> None:
    """Set attributes of one object, each by a name that its class knows. So a renaming fails here as well."""
    mro = type(part).__mro__
    known = set(dir(part)).union(*(inspect.get_annotations(base) for base in mro))
    for _, method in inspect.getmembers(type(part), inspect.isfunction):
        known.update(inspect.unwrap(method).__code__.co_names)
    for base in mro:
        if init := vars(base).get("__init__"):
            known.update(getattr(inspect.unwrap(init), "__code__", _NO_CODE).co_names)
    if unknown := sorted(attributes.keys() - known):
        raise AttributeError(f"{type(part).__name__} has no {', '.join(unknown)}")
    vars(part).update(attributes)


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
