"""Control's link to the compiler process, which parses specifications for it.

The process is started on demand and ends when it is idle. Specifications that exceed its limits end it and are refused;
those in force stay.

Orders precede dry runs: one dry run at a time begins while no order is compiled, and an order ends it.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from appliance.base.withdrawal import require_awaited
from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.link import Link
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
    SpecificationsRefusedError,
    checked,
    require_bounded,
)

_START_SECONDS = 60.0  # on a machine that is busy starting
_WORK_SECONDS = 180.0  # on a busy machine; the compiler bounds its processor time
_LOOK_SECONDS = 1.0  # between two checks whether the client of the order still waits
_ENDED = "the compiler exited while it read them, possibly at its limit of memory or time; check the log"
_ENDED_BY_ORDER = "the dry run was stopped, because a change needed the compiler: try again"
_TRIES = 2  # an idle compiler may end just when it is asked


class SpecificationCompiler:
    """Control's end of the link; `wanted()` has the compiler process started."""

    def __init__(self, wanted: Callable[[], None]) -> None:
        self._wanted = wanted
        self._link = Link(self._heard)
        self._there = asyncio.Event()
        self._called = False
        self._orders = 0  # that are being compiled
        self._no_order = asyncio.Event()
        self._no_order.set()
        self._one_dry_run = asyncio.Lock()
        self._dry_run = False  # whether one is being compiled

    def call(self) -> None:
        """Start the compiler, because there will soon be something to compile."""
        if self._link.channel is None and not self._called:
            self._there.clear()
            self._called = True
            self._wanted()

    def attach(self, channel: Channel) -> None:
        """Use the compiler process that has started."""
        self._link.attach(channel)
        self._called = False
        self._there.set()

    async def check(self, sources: Sources, site_keys: Sequence[str]) -> CheckedSpecifications:
        """Compile for an order. Raises `SpecificationsRefusedError`, also when the compiler does not answer."""
        if not sources.files:
            return CheckedSpecifications()
        require_bounded(sources)
        with self._order():
            answer = await self._asked(
                lambda number: messages.ContentsWanted(number, sources.files, sources.definitions)
            )
        return checked(answer.contents, sources, site_keys)

    async def try_out(self, sources: Sources, site_keys: Sequence[str]) -> CheckedSpecifications:
        """Compile for a dry run. Raises as `check`, also when an order ended it."""
        if not sources.files:
            return CheckedSpecifications()
        require_bounded(sources)
        async with self._one_dry_run:
            await self._no_order.wait()
            self._dry_run = True
            try:
                answer = await self._asked(
                    lambda number: messages.ContentsWanted(
                        number, sources.files, sources.definitions, dry_run=True
                    ),
                    goes_on=lambda: not self._orders,
                )
            finally:
                self._dry_run = False
        return checked(answer.contents, sources, site_keys)

    async def parts(self, compiled: bytes, wanted: list[messages.PartNames]) -> list[bytes]:
        """Compile the parts of relays. Raises `SpecificationsRefusedError`, also when the compiler does not answer."""
        with self._order():
            answer: messages.PartsMade = await self._asked(
                lambda number: messages.PartsWanted(number, compiled, wanted)
            )
        return answer.parts

    @contextlib.contextmanager
    def _order(self) -> Iterator[None]:
        """End a dry run, and let no other begin while an order is compiled."""
        self._orders += 1
        self._no_order.clear()
        if self._dry_run:
            self._link.close()  # the compiler ends with the work that it has
        try:
            yield
        finally:
            self._orders -= 1
            if not self._orders:
                self._no_order.set()

    async def _asked(
        self, question: Callable[[int], messages.Message], *, goes_on: Callable[[], bool] = lambda: True
    ) -> Any:
        """Return the answer, while `goes_on()`; if the compiler has just ended, ask the next one."""
        for _ in range(_TRIES):
            try:
                self.call()
                async with asyncio.timeout(_START_SECONDS):
                    await self._there.wait()
                if not goes_on():
                    raise SpecificationsRefusedError([_ENDED_BY_ORDER])
                answer = await self._answer(question)
            except ChannelClosedError:
                if not goes_on():
                    raise SpecificationsRefusedError([_ENDED_BY_ORDER]) from None
                continue
            except TimeoutError:
                self._called = False
                raise SpecificationsRefusedError(
                    ["the compiler does not answer; try again, or check the log"]
                ) from None
            if isinstance(answer, messages.CompilationRefused):
                raise SpecificationsRefusedError(answer.findings)
            return answer
        raise SpecificationsRefusedError([_ENDED])

    async def _answer(self, question: Callable[[int], messages.Message]) -> Any:
        """Ask, and end the compiler if the order is withdrawn meanwhile. Raises as `Link.ask`."""
        asking = asyncio.ensure_future(self._link.ask(question, _WORK_SECONDS))
        try:
            while not (await asyncio.wait((asking,), timeout=_LOOK_SECONDS))[0]:
                require_awaited()
        except BaseException:
            asking.cancel()
            self._link.close()
            raise
        return asking.result()

    def _heard(self, message: Any) -> None:
        self._link.answered(message.number, message)
