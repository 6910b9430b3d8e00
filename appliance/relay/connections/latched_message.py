"""The last message of a latching publisher, kept in the memory of the publisher's host."""

from collections.abc import Callable

from appliance.relay.transport.frames import Batch
from appliance.relay.transport.memory import HostMemory


class LatchedMessage:
    """The message that late subscribers of one topic get, or none; `share` counts its memory.

    `refused(size)` is called for the first message that is not kept.
    """

    def __init__(
        self, share: HostMemory, make_room: Callable[[int], None], refused: Callable[[int], None]
    ) -> None:
        self._share = share
        self._make_room = make_room
        self._refused = refused
        self._refused_size: int | None = None
        self.batch: Batch | None = None
        self.is_latching = False
        self.withheld = False
        """Whether monitors have held back a message of this publisher."""

    @property
    def size(self) -> int:
        return 0 if self.batch is None else len(self.batch.view)

    @property
    def is_lacking(self) -> bool:
        return self.is_latching and self.withheld and self.batch is None

    @property
    def is_asked_again(self) -> bool:
        return self._refused_size is not None and not self._share.refusal(self._refused_size)

    @property
    def is_refused(self) -> bool:
        return self._refused_size is not None

    def keep(self, batch: Batch) -> None:
        self._free()
        size = len(batch.view) - batch.find_last()
        if self._share.refusal(size):
            self._make_room(size)
        if self._share.refusal(size):
            self._refuse(size)
        else:
            self._refused_size = None
            self._share.add(size)
            self.batch = batch.keep_last()

    def forget(self) -> None:
        self._free()
        self._refused_size = None
        self.withheld = False

    def give_up(self) -> None:
        size = self.size
        self._free()
        self._refuse(size)

    def repeat(self) -> None:
        if self._refused_size is not None:
            self._refused(self._refused_size)

    def _free(self) -> None:
        if self.batch is not None:
            self._share.add(-len(self.batch.view))
            self.batch = None

    def _refuse(self, size: int) -> None:
        before, self._refused_size = self._refused_size, size
        if before is None:
            self._refused(size)
