"""Control's link to the compiler process, which parses specifications for it.

Specifications that exceed the compiler's limits end it, and are refused. A new order ends a dry run. The answers for a
start are kept, so that a restart compiles nothing that is unchanged, and neither does a standby that has checked its
start, while the robot waits for its takeover.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import msgspec

from appliance.base.withdrawal import require_awaited
from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.link import Link
from appliance.specifications.compiled_store import CompiledStore
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
M = TypeVar("M", bound=messages.Message)
_TRIES = 2  # an idle compiler may end just when a question is sent


class SpecificationCompiler:
    """Passes specifications to the compiler process, whose start `wanted()` requests.

    Compilations raise `SpecificationsRefusedError`, even without an answer.
    """

    def __init__(self, wanted: Callable[[], None], store: CompiledStore | None = None) -> None:
        """Without a `store`, answers are kept until control ends."""
        self._wanted = wanted
        self._store = store
        self._link = Link(self._heard)
        self._there = asyncio.Event()
        self._called = False
        self._orders = 0  # number of orders that are being compiled
        self._no_order = asyncio.Event()
        self._no_order.set()
        self._one_dry_run = asyncio.Lock()
        self._dry_run = False  # whether a dry run is being compiled
        # the last question for each kind of answer, and the answer
        self._kept: dict[type, tuple[messages.Message, messages.Message]] = {}

    def call_early(self) -> None:
        """Start the compiler before the first question, unless answers are kept from an earlier start."""
        if not self._store:
            self.call()

    def call(self) -> None:
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
        return await self._check(sources, site_keys, broken)

    async def check_at_start(
        self, sources: Sources, site_keys: Sequence[str], known: Sequence[str] | None = None
    ) -> CheckedSpecifications:
        """Compile for a start: files with errors do not keep the others from coming into force.

        `known` are the warnings that were found when these sources were loaded; they are not looked for again.
        """
        checked = await self._check(sources, site_keys, (), at_start=True, lints=known is None)
        return checked if known is None else msgspec.structs.replace(checked, warnings=tuple(known))

    async def _check(
        self,
        sources: Sources,
        site_keys: Sequence[str],
        broken: Sequence[str],
        *,
        at_start: bool = False,
        lints: bool = True,
    ) -> CheckedSpecifications:
        if not sources.files:
            return CheckedSpecifications()
        require_bounded(sources)
        question = _question(sources, broken, at_start=at_start, lints=lints)
        if at_start:
            answer = await self._ask_once(question, messages.ContentsFound)
        else:
            answer = await self._ordered(question, messages.ContentsFound)
        return checked(answer.contents, sources, site_keys)

    async def try_out(
        self, sources: Sources, site_keys: Sequence[str], broken: Sequence[str] = ()
    ) -> CheckedSpecifications:
        if not sources.files:
            return CheckedSpecifications()
        require_bounded(sources)
        async with self._one_dry_run:
            await self._no_order.wait()
            self._dry_run = True
            try:
                answer = await self._ask(
                    _question(sources, broken, dry_run=True),
                    messages.ContentsFound,
                    goes_on=lambda: not self._orders,
                )
            finally:
                self._dry_run = False
        return checked(answer.contents, sources, site_keys)

    async def parts(self, compiled: bytes, wanted: list[messages.PartNames]) -> list[bytes]:
        answer = await self._ask_once(
            lambda number: messages.PartsWanted(number, compiled, wanted), messages.PartsMade
        )
        return answer.parts

    async def _ask_once(self, question: Callable[[int], messages.Message], kind: type[M]) -> M:
        wanted = question(0)
        last, answer = self._kept.get(kind, (None, None))
        if last == wanted and isinstance(answer, kind):
            return answer
        found = await asyncio.to_thread(self._find, wanted, kind)
        if found is None:
            found = await self._ordered(question, kind)
            if self._store is not None:
                await asyncio.to_thread(self._store.keep, wanted, found)
        self._kept[kind] = wanted, found
        return found

    def _find(self, wanted: messages.Message, kind: type[M]) -> M | None:
        if self._store is None:
            return None
        found = self._store.find(wanted, kind)
        if found is None and isinstance(wanted, messages.ContentsWanted) and not wanted.lints:
            # The first start with these specifications also looked for warnings.
            found = self._store.find(msgspec.structs.replace(wanted, lints=True), kind)
        return found

    async def _ordered(self, question: Callable[[int], messages.Message], kind: type[M]) -> M:
        with self._order():
            return await self._ask(question, kind)

    @contextlib.contextmanager
    def _order(self) -> Iterator[None]:
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

    async def _ask(
        self,
        question: Callable[[int], messages.Message],
        kind: type[M],
        *,
        goes_on: Callable[[], bool] = lambda: True,
    ) -> M:
        """Return the answer; while `goes_on()`, ask the successor of a compiler that has just ended."""
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
            if not isinstance(answer, kind):
                raise TypeError(f"the compiler answered a {type(answer).__name__}, not a {kind.__name__}")
            return answer
        raise SpecificationsRefusedError([_ENDED])

    async def _answer(self, question: Callable[[int], messages.Message]) -> object:
        asking = asyncio.ensure_future(self._link.ask(question, _WORK_SECONDS))
        try:
            while not (await asyncio.wait((asking,), timeout=_LOOK_SECONDS))[0]:
                require_awaited()
        except BaseException:
            asking.cancel()
            self._link.close()
            raise
        return asking.result()

    def _heard(self, message: object) -> None:
        if isinstance(message, messages.ContentsFound | messages.PartsMade | messages.CompilationRefused):
            self._link.answered(message.number, message)


def _question(
    sources: Sources,
    broken: Sequence[str],
    *,
    at_start: bool = False,
    dry_run: bool = False,
    lints: bool = True,
) -> Callable[[int], messages.ContentsWanted]:
    return lambda number: messages.ContentsWanted(
        number,
        sources.files,
        sources.definitions,
        at_start=at_start,
        dry_run=dry_run,
        topics=sources.topics,
        broken=[*broken],
        lints=lints,
    )
