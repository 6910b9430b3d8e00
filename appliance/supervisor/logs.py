"""Configure the logs of all processes: on standard error, readable on a terminal, otherwise JSON.

A terminal gets no control characters, because names and reasons come from the network.
"""

import io
import logging
import sys
from typing import Any, TextIO, cast

from appliance.base.log_output import replace_stderr

_rich = sys.modules.pop("rich", None)
sys.modules["rich"] = cast(Any, None)  # otherwise structlog would load rich for its tracebacks
import structlog  # noqa: E402  see above

del sys.modules["rich"]
if _rich is not None:
    sys.modules["rich"] = _rich

# Tracebacks never show values of local variables, because a token or a key might be among them.
_transform = structlog.tracebacks.ExceptionDictTransformer(show_locals=False)


def configure_logs(process: str) -> None:
    """Send the log, and everything else that is written to `sys.stderr`, through a `LogOutput`."""
    human = sys.stderr.isatty()
    shared: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="%H:%M:%S" if human else "iso", utc=not human),
    ]
    renderer: list[structlog.typing.Processor] = (
        [_printable, structlog.dev.ConsoleRenderer(exception_formatter=_traceback)]
        if human
        else [structlog.processors.ExceptionRenderer(_transform), structlog.processors.JSONRenderer()]
    )
    output = replace_stderr(_lost)
    handler = logging.StreamHandler(output)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *renderer],
        )
    )
    logging.basicConfig(handlers=[handler], level=logging.INFO, force=True)
    structlog.configure(
        processors=[*shared, *renderer],
        logger_factory=structlog.WriteLoggerFactory(output),
        cache_logger_on_first_use=False,
    )
    structlog.contextvars.bind_contextvars(process=process)


def _lost(lines: int, since: str) -> str:
    """Return a line of the log, which the caller writes."""
    log = structlog.wrap_logger(structlog.ReturnLogger())
    return f"{log.warning(f'lines of the log were lost since {since}', lines=lines)}\n"


def _printable(
    _logger: object, _method: str, event: structlog.typing.EventDict
) -> structlog.typing.EventDict:
    return {name: _shown(value) if isinstance(value, str) else value for name, value in event.items()}


def _traceback(stream: TextIO, error: structlog.typing.ExcInfo) -> None:
    written = io.StringIO()
    structlog.dev.plain_traceback(written, error)
    stream.write("\n".join(map(_shown, written.getvalue().split("\n"))))


def _shown(text: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def write_line(text: str, stream: TextIO) -> None:
    """Write a line, in JSON if there is no terminal. Raises `OSError`."""
    if stream.isatty() or sys.stderr.isatty():
        stream.write(f"{text}\n")
        stream.flush()
    else:
        structlog.wrap_logger(structlog.WriteLogger(stream)).info(text)
