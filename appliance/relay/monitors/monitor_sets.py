"""Create monitors from compiled specifications; this runs in the thread of `Loader`."""

import functools
import gc
import time
from collections.abc import Callable, Hashable

from appliance.channel.messages import SpecificationsStated
from rosmop.fast import load
from rosmop.run.engine import MonitorSet

_TICKS_SECONDS = 0.2  # seconds of processor time that ticks and deadlines may take at once
_SHADOW_TICKS_SECONDS = 0.02
_DEADLINES = 100  # deadlines of slices that are processed at once: some milliseconds


def monitor_set(
    message: SpecificationsStated, holder_of: Callable[[int], Hashable]
) -> MonitorSet | list[str]:
    try:
        compiled, fast = load.load_part(message.part)
    except ValueError as error:
        return [f"control's specifications cannot be decoded: {error}"]
    return MonitorSet.of(
        compiled,
        message.on_fault,
        _patience,
        fast=fast,
        shadows=message.shadows,
        shadow_patience=lambda: _patience(_SHADOW_TICKS_SECONDS),
        slices=message.slices,
        deadlines=_DEADLINES,
        holder_of=holder_of,
    )


@functools.cache
def prepare() -> None:
    """Load the WebAssembly library, and exclude its objects from garbage collection, which would delay messages."""
    load.prepare()
    gc.freeze()


def _patience(seconds: float = _TICKS_SECONDS) -> Callable[[], bool]:
    ends = time.thread_time() + seconds
    return lambda: time.thread_time() > ends
