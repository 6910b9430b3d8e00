"""Wait while another program holds a port of the appliance, such as a ROS master that the robot started first.

Without this wait, the service would end before that program does, and the robot would run on without the appliance.
The status of the service, the log and `rosrv status` give the reason. A person at a terminal gets it as an error.
"""

import asyncio
import contextlib
import signal
import socket
from collections.abc import AsyncIterator, Callable
from typing import TypeVar

import structlog

from appliance.base import clock
from appliance.supervisor import signals
from appliance.supervisor.errors import PortInUseError
from appliance.supervisor.lapse_answers import answer_for_control
from appliance.supervisor.service_manager import ServiceManager

_LOOK_SECONDS = 2.0
_SAY_SECONDS = 600.0  # between two equal lines of the log

T = TypeVar("T")

log = structlog.get_logger()


def built_when_free(build: Callable[[], T], manager: ServiceManager, admin: socket.socket) -> T | None:
    """Call `build` until it raises no `PortInUseError`; return its result, or None if a signal ended the wait.

    The requests on the admin socket get the reason. Signals are held while `build` runs.
    """
    try:
        return build()
    except PortInUseError as error:
        reason = str(error)
    return asyncio.run(_built_later(build, reason, manager, admin))


async def _built_later(
    build: Callable[[], T], reason: str, manager: ServiceManager, admin: socket.socket
) -> T | None:
    stopped, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopped.set)
    loop.add_signal_handler(signal.SIGHUP, lambda: None)  # the policy is read when it starts
    async with manager.watched():
        while True:
            try:
                async with _said(f"waits: {reason}", manager, admin):
                    return await _retried(build, reason, stopped)
            except PortInUseError as error:
                reason = str(error)


async def _retried(build: Callable[[], T], reason: str, stopped: asyncio.Event) -> T | None:
    """Return what `build` returns, or None if `stopped` is set. Raises `PortInUseError` for another reason."""
    began = clock.now()
    while True:
        with signals.heard(), contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_LOOK_SECONDS):
                await stopped.wait()
        for _ in range(3):  # let the loop deliver a signal of the last moment
            await asyncio.sleep(0)
        if stopped.is_set():
            return None
        try:
            return build()
        except PortInUseError as error:
            if str(error) != reason or clock.now() - began > _SAY_SECONDS:
                raise


@contextlib.asynccontextmanager
async def _said(reason: str, manager: ServiceManager, admin: socket.socket) -> AsyncIterator[None]:
    log.error(reason)
    manager.starting(reason)
    answers = asyncio.create_task(answer_for_control(admin.dup, reason))
    try:
        yield
    finally:
        answers.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await answers
