"""Run a coroutine in the turns of a host (`processor_time`), and without a delay if the host has its turn.

asyncio starts a task in a later turn of the loop. Most requests wait for nothing, so a `HostTask` runs its first step
when it is made, like an eager task of Python 3.12.
"""

import asyncio
from asyncio import _enter_task, _leave_task, _register_task  # documented, for other implementations of tasks
from collections.abc import Coroutine
from typing import Any, TypeVar

from appliance.policy.model import Address
from appliance.rpc.processor_time import ProcessorTime

T = TypeVar("T")


class HostTask(asyncio.Future[T]):
    """Its steps, from one `await` to the next, wait for the turn of a host and are charged to it.

    If a piece of the host's work makes the task, the first step is part of this piece.
    """

    def __init__(self, time: ProcessorTime, host: Address, work: Coroutine[Any, Any, T]) -> None:
        super().__init__()
        self._time = time
        self._host = host
        self._work = work
        self._awaited: asyncio.Future[Any] | None = None
        self._cancels = 0  # without those that `uncancel` has undone
        self._cancel_soon = False  # whether the next step raises `CancelledError` in the coroutine
        if time.running:
            self._step()
        else:
            self._go_on()
        if not self.done():
            _register_task(self)  # type: ignore[arg-type]  # it has the methods of a task

    def cancel(self, msg: Any | None = None) -> bool:
        """Return False if the task has ended."""
        if self.done():
            return False
        self._cancels += 1
        self._cancel_soon = self._awaited is None or not self._awaited.cancel(msg)
        return True

    def cancelling(self) -> int:
        """Cancellations that `uncancel` has not undone."""
        return self._cancels

    def uncancel(self) -> int:
        """Return the number of the others."""
        self._cancels = max(0, self._cancels - 1)
        return self._cancels

    def _go_on(self, _awaited: asyncio.Future[Any] | None = None) -> None:
        self._awaited = None
        self._time.run(self._host, self._step)

    def _step(self) -> None:
        loop = self.get_loop()
        outer = asyncio.current_task(loop)  # if this task is made in a step of another one
        if outer is not None:
            _leave_task(loop, outer)
        _enter_task(loop, self)  # type: ignore[arg-type]  # as above
        try:
            self._wait_for(self._resume())
        except StopIteration as done:
            self.set_result(done.value)
        except asyncio.CancelledError:
            super().cancel()
        except Exception as error:  # noqa: BLE001 - passed on to the owner of the task
            self.set_exception(error)
        finally:
            _leave_task(loop, self)  # type: ignore[arg-type]  # as above
            if outer is not None:
                _enter_task(loop, outer)

    def _resume(self) -> asyncio.Future[Any] | None:
        """Run to the next `await`, and return what is awaited. Raises `StopIteration` at the end."""
        if self._cancel_soon:
            self._cancel_soon = False
            return self._work.throw(asyncio.CancelledError())  # type: ignore[no-any-return]  # a future, or None
        return self._work.send(None)  # type: ignore[no-any-return]  # same

    def _wait_for(self, awaited: asyncio.Future[Any] | None) -> None:
        if awaited is None:  # `asyncio.sleep(0)`
            self.get_loop().call_soon(self._go_on)
            return
        awaited._asyncio_future_blocking = False  # as asyncio requires of tasks
        awaited.add_done_callback(self._go_on)
        self._awaited = awaited
        if self._cancel_soon:
            self._cancel_soon = not awaited.cancel()
