"""Control's link to the compiler process, which parses specifications for it.

The process is started on demand and ends when it is idle. Specifications that exceed its limits are refused and end
the process; the specifications in force stay in force.

Orders take precedence over dry runs. A dry run begins only while no order is compiled and no other dry run is under
way; a new order ends it.

The last answer for a start is kept, and the last parts. So a standby that has checked its start compiles nothing when
it takes over, while the robot waits.
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
_LOOK_SECONDS = 1.0  # between two checks that the client of the order still waits
_ENDED = "the compiler exited while it read them, possibly at its limit of memory or time; check the log"
_ENDED_BY_ORDER = "the dry run was stopped, because a change needed the compiler: try again"
_TRIES = 2  # an idle compiler may end just when a question is sent


class SpecificationCompiler:
    """`wanted()` requests the start of the compiler process."""

    def __init__(self, wanted: Callable[[], None]) -> None:
        self._wanted = wanted
        self._link = Link(self._heard)
        self._there = asyncio.Event()
        self._called = False
        self._orders = 0  # number of orders that are being compiled
        self._no_order = asyncio.Event()
        self._no_order.set()
        self._one_dry_run = asyncio.Lock()
        self._dry_run = False  # whether a dry run is being compiled
        self._kept: dict[
            type, tuple[messages.Message, Any]
        ] = {}  # the last question of each kind, and its answer

    def call(self) -> None:
        """Start the compiler early, because a compilation will soon be requested."""
        if self._link.channel is None and not self._called:
            self._there.clear()
            self._called = True
            self._wanted()

    def attach(self, channel: Channel) -> None:
        self._link.attach(channel)
        self._called = False
        self._there.set()

    async def check(
        self, sources: Sources, site_keys: Sequence[str], broken: Sequence[str] = ()
    ) -> CheckedSpecifications:
        """For an order. Files in `broken` may have errors, as after a start.

        Raises `SpecificationsRefusedError`, also if the compiler does not answer.
        """
        return await self._checked(sources, site_keys, broken, at_start=False)

    async def check_at_start(self, sources: Sources, site_keys: Sequence[str]) -> CheckedSpecifications:
        """Compile for a start: files with errors do not keep the others from coming into force
        (`Contents.unbuilt`).

        Raises the errors of `check`.
        """
        return await self._checked(sources, site_keys, (), at_start=True)

    async def _checked(
        self, sources: Sources, site_keys: Sequence[str], broken: Sequence[str], *, at_start: bool
    ) -> CheckedSpecifications:
        if not sources.files:
            return CheckedSpecifications()
        require_bounded(sources)
        ask = self._asked_once if at_start else self._ordered
        answer = await ask(_wanted(sources, broken, at_start=at_start))
        return checked(answer.contents, sources, site_keys)

    async def try_out(
        self, sources: Sources, site_keys: Sequence[str], broken: Sequence[str] = ()
    ) -> CheckedSpecifications:
        """For a dry run. Raises the errors of `check`, also if an order ended the dry run."""
        if not sources.files:
            return CheckedSpecifications()
        require_bounded(sources)
        async with self._one_dry_run:
            await self._no_order.wait()
            self._dry_run = True
            try:
                answer = await self._asked(
                    _wanted(sources, broken, dry_run=True),
                    goes_on=lambda: not self._orders,
                )
            finally:
                self._dry_run = False
        return checked(answer.contents, sources, site_keys)

    async def parts(self, compiled: bytes, wanted: list[messages.PartNames]) -> list[bytes]:
        """Return the parts that relays run. Raises `SpecificationsRefusedError`, also without an answer."""
        answer = await self._asked_once(lambda number: messages.PartsWanted(number, compiled, wanted))
        parts: list[bytes] = answer.parts
        return parts

    async def _asked_once(self, question: Callable[[int], messages.Message]) -> Any:
        """Return the answer to a question, or the last answer if the question is the same. Raises as `_asked`
        does.
        """
        wanted = question(0)
        last, answer = self._kept.get(type(wanted), (None, None))
        if last != wanted:
            answer = await self._ordered(question)
            self._kept[type(wanted)] = wanted, answer
        return answer

    async def _ordered(self, question: Callable[[int], messages.Message]) -> Any:
        """Return the answer for an order. Raises as `_asked` does."""
        with self._order():
            return await self._asked(question)

    @contextlib.contextmanager
    def _order(self) -> Iterator[None]:
        """End a dry run in progress, and let none begin in the block."""
        self._orders += 1
        self._no_order.clear()
        if self._dry_run:
            self._link.close()  # without its link, the compiler ends together with its work
        try:
            yield
        finally:
            self._orders -= 1
            if not self._orders:
                self._no_order.set()

    async def _asked(
        self, question: Callable[[int], messages.Message], *, goes_on: Callable[[], bool] = lambda: True
    ) -> Any:
        """Return the compiler's answer, or its successor's if it has just ended.

        Raises `SpecificationsRefusedError`, also if `goes_on()` returns False.
        """
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
        """Return the answer; end the compiler if the order is withdrawn before. Raises the errors of `Link.ask`."""
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


def _wanted(
    sources: Sources, broken: Sequence[str], *, at_start: bool = False, dry_run: bool = False
) -> Callable[[int], messages.ContentsWanted]:
    return lambda number: messages.ContentsWanted(
        number,
        sources.files,
        sources.definitions,
        at_start=at_start,
        dry_run=dry_run,
        topics=sources.topics,
        broken=[*broken],
    )
