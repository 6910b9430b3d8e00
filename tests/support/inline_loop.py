import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class InlineLoop(asyncio.SelectorEventLoop):
    def run_in_executor(  # type: ignore[override]  # typeshed knows the variadic types of Python 3.11 only
        self, _executor: Any, function: Callable[..., T], *arguments: Any
    ) -> "asyncio.Future[T]":
        done: asyncio.Future[T] = self.create_future()
        try:
            done.set_result(function(*arguments))
        except Exception as error:  # noqa: BLE001  the caller gets it from the future
            done.set_exception(error)
        return done


def run(play: Coroutine[Any, Any, T]) -> T:
    with asyncio.Runner(loop_factory=InlineLoop) as runner:
        return runner.run(play)
