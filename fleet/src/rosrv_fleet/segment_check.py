"""Verify an upload within a limit of processor time. Runs in a worker."""

import gzip
import time
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from appliance.formats.segments import SegmentError, SegmentReader, SegmentSummary
from rosrv_fleet.workers import OutOfTimeError, processor_time


class SegmentVerdict(NamedTuple):
    """The summary of a valid segment, or the reason why it is invalid. `late`: the time limit was too short.

    `size` is the number of uncompressed bytes that were read, `seconds` the processor time.
    """

    summary: SegmentSummary | None
    reason: str
    late: bool
    size: int
    seconds: float


def check_segment(upload: Path, keys: Collection[bytes], most_bytes: int, seconds: float) -> SegmentVerdict:
    """Verify a segment with raw public keys, in at most `seconds` of processor time. Raise `OSError`."""
    begun = time.process_time()
    summary, reason, late = None, "", False
    with gzip.open(upload) as file:
        try:
            with processor_time(seconds):
                summary = SegmentReader(file, keys, most_bytes).summary()
        except OutOfTimeError as error:
            reason, late = str(error), True
        except (SegmentError, EOFError, zlib.error, gzip.BadGzipFile) as error:
            reason = str(error)
        return SegmentVerdict(summary, reason, late, file.tell(), time.process_time() - begun)
