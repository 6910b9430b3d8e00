"""From an exception to a place in the text and the values of variables."""

import struct

from rosmop.form.positions import Position
from rosmop.form.sites import Site, showing
from rosmop.run.interpreter import Failed, Interpreter
from rosmop.run.outcomes import Fault
from rosmop.runtime.action_context import FaultError, MalformedError


def explain(error: Exception, interpreter: Interpreter, monitor: str, otherwise: Position) -> Fault:
    """The fault that an exception is. `otherwise` is where it stands if there is no better place."""
    failed = interpreter.failed if error is interpreter.failed.error else Failed()
    interpreter.failed = Failed()  # the error has what it came through, and so much else
    site = interpreter.sites[failed.site] if failed.site >= 0 else Site(otherwise)
    values = {}
    for variable in site.variables:
        try:
            value = interpreter.value(variable.code, failed.variables)
        except KeyError:  # it has none yet
            continue
        values[variable.name] = showing(variable.type)(value)
    return Fault(monitor, site.position, _text(error), values)


def _text(error: Exception) -> str:
    if isinstance(error, FaultError):
        return error.text
    if isinstance(error, MalformedError):
        return f"the bytes are not a message of this type: {error}"
    if isinstance(error, struct.error):
        return "the bytes are not a message of this type: it ends before its last field"
    return f"{type(error).__name__}: {error}"
