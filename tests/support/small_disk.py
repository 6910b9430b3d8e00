"""File systems that are full after a few bytes."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.requirements import need_root


@contextmanager
def small_disk(place: Path, size: str, *options: str) -> Iterator[Path]:
    """Mount an empty file system at a folder, which is made if necessary.

    `size` and `options` are those of `mount -t tmpfs`. The end does not wait for open files: a process that was killed
    a moment ago may still have one.
    """
    need_root()
    place.mkdir(exist_ok=True)
    words = ",".join([f"size={size}", *options])
    subprocess.run(["mount", "-t", "tmpfs", "-o", words, "rosrv-test", place], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", place], check=True)
