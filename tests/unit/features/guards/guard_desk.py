"""The specifications of an appliance with guards, on real parts. Each set of texts is compiled once for a process."""

import json
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from functools import cache
from pathlib import Path
from typing import Any

from appliance.channel.messages import Contents
from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.specifications.checking import check, contents
from appliance.specifications.specification_files import CheckedSpecifications, Sources
from appliance.specifications.specification_manager import SpecificationManager
from tests.unit.specifications.monitor_desk import Desk

TYPES = {"command": "geometry_msgs/Twist", "by": "nav_msgs/Odometry"}
FENCE = Guard("fence", PRESETS["fence"], types=TYPES, values={"polygon": "0,0 1,0 1,1"})
FILES = {"fence.rv": text_of(FENCE), "other.rv": "other() { event said() /chatter std_msgs/String '{}' { } }"}


@cache
def _compiled(texts: str) -> Contents:
    files, definitions, topics = json.loads(texts)
    return contents(files, definitions, given_topics=topics, lints=False)


def compiled_once(
    files: Mapping[str, str], texts: Mapping[str, str], *, given_topics: Mapping[str, Mapping[str, str]]
) -> Contents:
    return _compiled(json.dumps([files, texts, given_topics]))


async def checked_once(
    sources: Sources, site_keys: Sequence[str], _present: Any = None
) -> CheckedSpecifications:
    return check(sources, site_keys, compiler=compiled_once)


async def without_parts(_compiled: bytes, wanted: Sequence[object]) -> list[bytes]:
    return [b""] * len(wanted)


@asynccontextmanager
async def monitors_of(
    home: Path, files: Mapping[str, str] = FILES, *, enable: str = "all"
) -> AsyncIterator[SpecificationManager]:
    """Yield the specifications after a start with these files; the relay accepts everything."""
    desk = Desk(home)
    desk.check = desk.check_at_start = desk.try_out = checked_once
    desk.parts = without_parts
    (desk.folder / "a.rv").unlink()
    for name, text in files.items():
        (desk.folder / name).write_text(text)
    try:
        yield await desk.monitors(enable)
    finally:
        desk.kill()
        desk.close()
