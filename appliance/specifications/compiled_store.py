"""Keep the compiler's answers over restarts, so that a start compiles no unchanged specification again.

1. A key is the digest of the question and of everything else that decides the answer: the source of the compiler and of
   all that it imports, its libraries, and the processor, whose machine code the answer contains. Anything unknown:
   nothing is kept.
2. Only control writes to the folder, and it sends the relays their code in any case. A file begins with the digest
   of its content; a damaged one is deleted, and its specifications are compiled.
3. Files that cannot be written are left out. The folder has a bounded number of files and bytes, and never takes the
   last free space of the disk. The files used longest ago go first.
"""

import contextlib
import hashlib
import os
import platform
import sys
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeVar

import msgspec
import structlog

from appliance.base.atomic_files import write_whole
from appliance.channel import messages

_MAX_FILES = 8  # a start has a question for the contents, and one for the parts of several relays
_MAX_BYTES = 64 << 20
_FREE_BYTES = 256 << 20  # left to the audit log and the state
SOURCES = ("rosmop", "roswire", "appliance")
LIBRARIES = ("wasmtime", "msgspec", "lark", "rosbags")
_PROCESSOR = ("flags", "Features", "model name", "CPU part", "isa")  # of /proc/cpuinfo

M = TypeVar("M", bound=messages.Message)

log = structlog.get_logger()
_encode = msgspec.msgpack.Encoder(order="deterministic").encode


class CompiledStore:
    """A cache of the compiler's answers, as files. The key is the question and the digest of the toolchain."""

    def __init__(self, folder: Path, toolchain: str | None = None) -> None:
        """`toolchain` is the digest of everything but the question (default: found when it is needed)."""
        self._folder = folder
        self._toolchain = toolchain

    def __bool__(self) -> bool:
        with contextlib.suppress(OSError):
            return any(self._folder.iterdir())
        return False

    def find(self, question: messages.Message, kind: type[M]) -> M | None:
        path = self._path(question)
        try:
            data = b"" if path is None else path.read_bytes()
        except OSError:
            return None
        if path is None:
            return None
        digest, content = data[:32], data[32:]
        try:
            if hashlib.sha256(content).digest() != digest:
                raise ValueError("its content has another digest")
            answer = msgspec.msgpack.decode(content, type=kind)
        except ValueError as error:
            log.warning(
                "a compiled module is damaged: it is compiled again", file=str(path), reason=str(error)
            )
            with contextlib.suppress(OSError):
                path.unlink()
            return None
        with contextlib.suppress(OSError):
            os.utime(path)
        return answer

    def keep(self, question: messages.Message, answer: messages.Message) -> None:
        path, content = self._path(question), msgspec.msgpack.encode(answer)
        if path is None or len(content) > _MAX_BYTES // 2:
            return
        try:
            self._folder.mkdir(mode=0o700, exist_ok=True)
            free = os.statvfs(self._folder)
            if free.f_bavail * free.f_frsize < len(content) + _FREE_BYTES:
                return
            write_whole(path, hashlib.sha256(content).digest() + content, 0o600)
            self._prune()
        except OSError as error:
            log.warning("a compiled module is not kept", error=str(error))

    def _prune(self) -> None:
        files = sorted(self._folder.iterdir(), key=lambda path: path.stat().st_mtime_ns, reverse=True)
        room = _MAX_BYTES
        for number, path in enumerate(files):
            room -= path.stat().st_size
            if number >= _MAX_FILES or room < 0:
                path.unlink()

    def _path(self, question: messages.Message) -> Path | None:
        if self._toolchain is None:
            self._toolchain = toolchain()
        if not self._toolchain:
            return None
        digest = hashlib.sha256(self._toolchain.encode())
        digest.update(_encode(question))
        return self._folder / digest.hexdigest()


def toolchain(processor: Path = Path("/proc/cpuinfo")) -> str:
    """Return the digest of compiler, libraries and processor; an empty text if one of them is unknown."""
    digest = hashlib.sha256(repr((sys.version_info, platform.machine())).encode())
    here = Path(__file__).parents[2]
    try:
        for file in sorted(path for folder in SOURCES for path in (here / folder).rglob("*.py")):
            digest.update(file.name.encode() + hashlib.sha256(file.read_bytes()).digest())
        for name in LIBRARIES:
            digest.update(f"{name} {version(name)}".encode())
        digest.update("\n".join(_describe(processor.read_text(errors="replace").splitlines())).encode())
    except (OSError, PackageNotFoundError):
        return ""
    return digest.hexdigest()


def _describe(lines: Iterable[str]) -> list[str]:
    """Return what the processors can do, once each."""
    return sorted({line for line in lines if line.partition("\t")[0].partition(":")[0].strip() in _PROCESSOR})
