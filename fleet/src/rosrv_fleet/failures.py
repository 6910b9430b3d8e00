"""Name the part that failed in the collector's background work, which continues after each failure."""

from concurrent.futures.process import BrokenProcessPool

import psycopg
import structlog

_PARTS = (
    (psycopg.Error, "the database"),
    (BrokenProcessPool, "a worker"),
    (OSError, "the store"),  # a full disk takes no marker
)
_log = structlog.get_logger()


def failure_of(error: Exception) -> str:
    """Return the failed part and the reason. Any other error is a defect, and logged with its traceback."""
    reason = str(error).strip() or type(error).__name__
    for kind, part in _PARTS:
        if isinstance(error, kind):
            return f"{part}: {reason}"
    _log.error("a defect of rosrv-fleet, please report it", exc_info=error)
    return f"a defect of rosrv-fleet, please report it: {type(error).__name__}: {reason}"
