"""Show the flight recorder in the status, the alarms and the metrics."""

from collections.abc import Iterator
from typing import Annotated

import msgspec

from appliance.base.metric import gauge
from appliance.channel.answers.field_docs import doc
from appliance.features.view import AlarmKind, FeatureView, StateView, Trouble


class RecorderState(msgspec.Struct, frozen=True):
    """The flight recorder: how many recordings are kept, their bytes, and how many are being made."""

    running: Annotated[bool, doc("whether it records now")]
    recordings: Annotated[int, doc("number of stored recordings")]
    bytes: Annotated[int, doc("bytes of all recordings")]
    in_progress: Annotated[int, doc("number of recordings that are being made")] = 0


_METRICS = (
    gauge("rosrv_recorder_up", "1 while the flight recorder runs; absent if recording is off"),
    gauge("rosrv_recordings", "stored recordings"),
    gauge("rosrv_recordings_bytes", "bytes of the stored recordings"),
)


def _alarms(state: RecorderState) -> Iterator[Trouble]:
    if not state.running:
        yield Trouble("recorder", "the flight recorder is not running: nothing is recorded")


def _line(state: RecorderState) -> tuple[str, str]:
    making = f", {state.in_progress} being made" if state.in_progress else ""
    noun = "recording" if state.recordings == 1 else "recordings"
    return "recorder", f"{state.recordings} {noun}, {state.bytes / 1e6:.1f} MB{making}"


RECORDER_VIEW = FeatureView(
    (
        StateView(
            "recorder",
            RecorderState,
            "the flight recorder, or null if nothing is recorded",
            before="switched_off",
            kinds={"recorder": AlarmKind("warning", "read why the recorder does not run")},
            alarms=_alarms,
            metrics=_METRICS,
            samples=lambda state: {
                "rosrv_recorder_up": [((), state.running)],
                "rosrv_recordings": [((), state.recordings)],
                "rosrv_recordings_bytes": [((), state.bytes)],
            },
            line=_line,
        ),
    ),
)
