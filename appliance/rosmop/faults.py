"""From an exception of generated code to a place in the text and the values of variables."""

import struct

from appliance.rosmop.compile.module import Module, Site
from appliance.rosmop.outcomes import Fault
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime.context import FaultError, MalformedError


def explain(error: Exception, module: Module, monitor: str, otherwise: Position) -> Fault:
    """The fault that an exception is. `otherwise` is where it stands if the code has no better place."""
    number, variables = module.place_of(error)
    site = module.sites[number] if number >= 0 else Site(otherwise)
    values = {}
    for name, code, show, _ in site.variables:
        value = variables.get(code, module.namespace.get(code, _MISSING))
        if value is not _MISSING:
            values[name] = show(value)
    return Fault(monitor, site.position, _text(error), values)


_MISSING = object()


def _text(error: Exception) -> str:
    if isinstance(error, FaultError):
        return error.text
    if isinstance(error, MalformedError):
        return f"the bytes are not a message of this type: {error}"
    if isinstance(error, struct.error):
        return "the bytes are not a message of this type: it ends before its last field"
    return f"{type(error).__name__}: {error}"
