"""Files that are there as a whole or not at all, whatever dies meanwhile."""

import os
from pathlib import Path


def write_whole(path: Path, data: bytes, mode: int) -> None:
    """Replace a file, on the disk when this returns. Raises `OSError`; the file before is then as it was."""
    making = path.with_name(path.name + ".new")
    making.unlink(missing_ok=True)
    descriptor = os.open(making, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        with os.fdopen(descriptor, "wb") as file:
            os.fchmod(descriptor, mode)  # whatever the mask is: the folder says who comes by
            file.write(data)
            file.flush()
            os.fsync(descriptor)
    except OSError as error:  # a full disk: the system does not say of which file
        making.unlink()
        error.filename = str(path)
        raise
    making.rename(path)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(folder)  # else the file before could come back with the power
    finally:
        os.close(folder)
