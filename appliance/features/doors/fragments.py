"""Keep the fragments of a client's frames until the frames are complete, within a limit of bytes."""

from dataclasses import dataclass, field

from appliance.features.doors.client_requests import ClientId
from appliance.features.doors.door_memory import ClientMemory
from appliance.features.doors.rosbridge_frames import FragmentOp, OperationError

_OVERHEAD = 200  # bytes that a fragment takes besides its text
_FRAME_OVERHEAD = 600  # bytes that a frame takes besides its id and its fragments


@dataclass(slots=True)
class _Incomplete:
    total: int
    parts: dict[int, bytes] = field(default_factory=dict)
    bytes: int = 0


class FragmentStore:
    """The incomplete frames of one client, with at most `most_bytes` in total."""

    def __init__(self, most_bytes: int, memory: ClientMemory) -> None:
        self._memory = memory
        self._most_bytes = most_bytes
        self._bytes = 0
        self._frames: dict[ClientId, _Incomplete] = {}

    def add(self, fragment: FragmentOp) -> bytes | None:
        frame = self._frames.get(fragment.id)
        if frame is None:
            frame = self._frames[fragment.id] = _Incomplete(fragment.total)
            self._charge(frame, _FRAME_OVERHEAD + len(str(fragment.id)))
        if fragment.total != frame.total or fragment.num >= frame.total or fragment.num in frame.parts:
            self._remove(fragment.id)
            raise OperationError(
                f"fragment {fragment.num} of {fragment.total} does not fit its frame of {frame.total}; send it again"
            )
        data = frame.parts[fragment.num] = fragment.data.encode()
        self._charge(frame, len(data) + _OVERHEAD)
        self._memory.unfinished.grew(("fragment", fragment.id), frame.bytes)
        if self._bytes > self._most_bytes or self._memory.refusal(0):
            for key in [*self._frames]:
                self._remove(key)
            raise OperationError(
                f"more than {self._most_bytes} bytes of fragments without the rest of their frames, or no memory of"
                " the door is left; all are dropped"
            )
        if len(frame.parts) < frame.total:
            return None
        self._remove(fragment.id)
        return b"".join(frame.parts[number] for number in range(frame.total))

    def _charge(self, frame: _Incomplete, size: int) -> None:
        frame.bytes += size
        self._bytes += size
        self._memory.add(size)

    def _remove(self, key: ClientId) -> None:
        size = self._frames.pop(key).bytes
        self._memory.unfinished.finished(("fragment", key))
        self._bytes -= size
        self._memory.add(-size)
