"""Monitors of what the compiler made: what `Loader` does, beside the loop."""

import functools
import gc
import time
from collections.abc import Callable

import msgspec

from appliance.channel.messages import SpecificationsStated
from rosmop.fast.abi import FeedModule, Part
from rosmop.fast.serialization import decoded_part
from rosmop.fast.wasm_instance import load
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.form.compiled import Compiled
from rosmop.run.engine import MonitorSet
from rosmop.run.slice_quota import HolderOf
from rosmop.types.messages import Messages
from roswire.definitions import Definitions

_TICKS_SECONDS = 0.2  # of processor time that ticks and deadlines may take in one go
_TRIAL_TICKS_SECONDS = 0.02
_DEADLINES = 100  # of slices that pass in one go: some milliseconds


def monitor_set(message: SpecificationsStated, holder_of: HolderOf) -> MonitorSet | list[str]:
    """Return the set that these specifications make, or why there is none."""
    try:
        part = decoded_part(message.part) if message.part else _NOTHING
    except msgspec.MsgspecError as error:
        return [f"what control states is no set of specifications: {error}"]
    return MonitorSet.of(
        part.compiled,
        message.on_fault,
        _patience,
        fast=WasmFastPath(part.module),
        trials=message.trials,
        trial_patience=lambda: _patience(_TRIAL_TICKS_SECONDS),
        slices=message.slices,
        deadlines=_DEADLINES,
        holder_of=holder_of,
    )


@functools.cache
def prepare() -> None:
    """Load the library of modules, and keep the garbage collector, which holds up messages, from all of it."""
    load()
    gc.freeze()


_NOTHING = Part(
    Compiled((), (), {}, (), {}, Messages(Definitions({})), ()),
    FeedModule(b"", 0, 0, 0, {}, (), {}, (), 0),
)


def _patience(seconds: float = _TICKS_SECONDS) -> Callable[[], bool]:
    ends = time.thread_time() + seconds
    return lambda: time.thread_time() > ends
