"""Background work that lasts as long as its process."""

import asyncio
from collections.abc import Awaitable, Callable

import structlog

_AGAIN_SECONDS = 1.0

_log = structlog.get_logger()


async def run_always(what: str, work: Callable[[], Awaitable[object]]) -> None:
    """Start `work` again a second after each error, until it returns or is cancelled.

    Any such error is a defect, which must not end other work of the process: its traceback is logged as a fault in
    `what`.
    """
    while True:
        try:
            await work()
        except Exception as error:  # noqa: BLE001  whatever it is, the work must go on
            _log.critical(f"fault in {what}, which starts again", exc_info=error)
            await asyncio.sleep(_AGAIN_SECONDS)
        else:
            return
