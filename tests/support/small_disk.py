import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.requirements import need_root


@contextmanager
def small_disk(path: Path, size: str, *options: str) -> Iterator[Path]:
    """Mount a small file system for the block, and unmount it even while a killed process has files open."""
    need_root()
    path.mkdir(exist_ok=True)
    words = ",".join([f"size={size}", *options])
    subprocess.run(["mount", "-t", "tmpfs", "-o", words, "rosrv-test", path], check=True)
    try:
        yield path
    finally:
        subprocess.run(["umount", "--lazy", path], check=True)


@contextmanager
def filled(path: Path, left: int = 0) -> Iterator[None]:
    """Fill the disk for the block, but for about `left` bytes."""
    filler = path / "filler"
    with filler.open("wb", buffering=0) as file:
        part = b"x" * (1 << 20)
        while part and shutil.disk_usage(path).free > left:
            try:
                part = part if file.write(part) == len(part) else part[:-1]
            except OSError:
                part = part[: len(part) // 2]
    try:
        yield
    finally:
        filler.unlink()
