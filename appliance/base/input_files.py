"""Read files that a person names: regular files only, with a size limit.

A named pipe may block its reader forever, a device may be endless, and a file may not fit in memory.
"""

import contextlib
import errno
import io
import ipaddress
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from appliance.base.owner_access import open_named

LONGEST = 64 << 20
"""The largest file that is read, in bytes."""

_MAX_HOSTS = 1 << 20  # bytes of /etc/hosts
_NULL = os.makedev(1, 3)  # /dev/null: an empty file
_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
}


def open_given(path: Path) -> io.BufferedReader:
    """Open a regular file, or a pipe that a shell made for `<(command)` or `command |`. Raises `OSError`."""
    descriptor = open_named(path)
    try:
        about = os.fstat(descriptor)
        kind = stat.S_IFMT(about.st_mode)
        if kind == stat.S_IFIFO and str(Path(f"/proc/self/fd/{descriptor}").readlink()).startswith("pipe:"):
            os.set_blocking(descriptor, True)
        elif kind != stat.S_IFREG and about.st_rdev != _NULL:
            what = f"not a regular file: it is {_KINDS.get(kind, 'something else')}"
            raise OSError(errno.EINVAL, what, str(path))
    except BaseException:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def read_given(path: Path, longest: int = LONGEST) -> bytes:
    """Return a file's content. Raises `OSError`, for example for more than `longest` bytes."""
    with open_given(path) as file:
        data = file.read(longest + 1)
    if len(data) > longest:
        raise OSError(errno.EFBIG, f"longer than {longest} bytes", str(path))
    return data


@contextlib.contextmanager
def path_for_library(path: Path) -> Iterator[Path]:
    """Yield a path for a library that opens the file: a copy in memory if only its owner may read it.

    Raises `OSError`.
    """
    if os.access(path, os.R_OK):
        yield path
        return
    content, memory = read_given(path), os.memfd_create(path.name)
    try:
        os.write(memory, content)
        yield Path(f"/proc/self/fd/{memory}")
    finally:
        os.close(memory)


def read_given_text(path: Path, encoding: str = "utf-8", errors: str = "strict") -> str:
    """Return a file's text, whose lines end with LF. Raises `OSError` and `UnicodeDecodeError`."""
    with io.TextIOWrapper(io.BytesIO(read_given(path)), encoding, errors) as text:
        return text.read()


def files_below(folder: Path) -> list[Path]:
    """Return the files in a folder and below; a link is a file.

    Raises `OSError` for a folder that may not be read, which `Path.glob` takes for empty.
    """
    paths: list[Path] = []
    for path, is_folder in entries_of(folder):
        paths += files_below(path) if is_folder else [path]
    return sorted(paths)


def entries_of(folder: Path) -> list[tuple[Path, bool]]:
    """Return the entries of a folder, and whether each is a folder; a link is not. Raises `OSError`."""
    descriptor = open_named(folder)
    try:
        with os.scandir(descriptor) as entries:
            return sorted((folder / entry.name, entry.is_dir(follow_symlinks=False)) for entry in entries)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from error
    finally:
        os.close(descriptor)


def stat_given(path: Path) -> os.stat_result:
    """Return the status of a file, or of the target of a link. Raises `OSError`."""
    try:
        return path.stat()
    except (PermissionError, FileNotFoundError):  # as in `open_named`
        descriptor = open_named(path)
    try:
        return os.fstat(descriptor)
    finally:
        os.close(descriptor)


def names_of_hosts(file: Path = Path("/etc/hosts")) -> dict[str, str]:
    """Return the first name of each address in a file like /etc/hosts; nothing if it cannot be read."""
    try:
        with file.open("rb") as lines:
            text = lines.read(_MAX_HOSTS).decode("ascii", "replace")
    except OSError:
        return {}
    names: dict[str, str] = {}
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if len(words) > 1:
            with contextlib.suppress(ValueError):
                names.setdefault(str(ipaddress.ip_address(words[0])), words[1])
    return names
