"""From an exception, of generated code or of the interpreter, to a place in the text and the values of variables."""

import struct
from collections.abc import Mapping
from types import TracebackType
from typing import Any

from appliance.rosmop.compile.module import FILENAME, Module, Site
from appliance.rosmop.ir.interpreter import Stopped
from appliance.rosmop.outcomes import Fault
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime.context import FaultError, MalformedError


def explain(error: Exception, module: Module, monitor: str, otherwise: Position) -> Fault:
    """The fault that an exception is. `otherwise` is where it stands if the code has no better place."""
    if isinstance(error, Stopped):
        number, variables, error = error.site, error.variables, error.error
    else:
        line, variables = _innermost(error.__traceback__)
        number = error.site if isinstance(error, FaultError) else -1
        if number < 0:
            number = module.site_of_line(line)
    site = module.sites[number] if number >= 0 else Site(otherwise)
    values = {}
    for name, code, show, _ in site.variables:
        value = variables.get(code, module.namespace.get(code, _MISSING))
        if value is not _MISSING:
            values[name] = show(value)
    return Fault(monitor, site.position, _text(error), values)


def happened(error: Exception, action_line: int) -> bool:
    """Whether an event had happened before the exception: its action, which begins at this line, had begun."""
    if isinstance(error, Stopped):
        return error.happened
    traceback = error.__traceback__
    while traceback is not None:
        if traceback.tb_frame.f_code.co_filename == FILENAME:
            return traceback.tb_lineno >= action_line
        traceback = traceback.tb_next
    return False


_MISSING = object()


def _text(error: Exception) -> str:
    if isinstance(error, FaultError):
        return error.text
    if isinstance(error, MalformedError):
        return f"the bytes are not a message of this type: {error}"
    if isinstance(error, struct.error):
        return "the bytes are not a message of this type: it ends before its last field"
    return f"{type(error).__name__}: {error}"


def _innermost(traceback: TracebackType | None) -> tuple[int, Mapping[str, Any]]:
    """The line and the local variables of the innermost function of generated code."""
    line: int = 0
    variables: Mapping[str, Any] = {}
    while traceback is not None:
        if traceback.tb_frame.f_code.co_filename == FILENAME:
            line, variables = traceback.tb_lineno, traceback.tb_frame.f_locals
        traceback = traceback.tb_next
    return line, variables
