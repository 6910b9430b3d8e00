"""List the recordings that a user names: files, folders and patterns."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from rosmop.recordings.recording import RecordingError

ENDINGS = (".bag", ".mcap")


class RecordingName(msgspec.Struct, frozen=True):
    """A path, with the size in bytes and the time of change, which identify the contents.

    `uri` escapes bytes outside UTF-8. `path` is absolute, because workers have other current folders.
    """

    uri: str
    size: int
    version: str
    path: bytes = b""


def recordings_of(files: Sequence[Path], sets: Sequence[str]) -> list[RecordingName]:
    """Return each recording once: the files, then those of each set in the order of their names.

    A set is a folder (with its folders) or a pattern. Raises `RecordingError` for an empty set.
    """
    names: dict[str, RecordingName] = {}
    for file in files:
        names.setdefault(os.path.realpath(file), local_recording(file))
    for one in sets:
        if one.startswith("s3://"):
            raise RecordingError(
                f"{one}: recordings are files; mount the bucket, or copy it with `aws s3 sync`"
            )
        paths = sorted(_paths(one))
        for path in paths:
            names.setdefault(os.path.realpath(path), local_recording(Path(path)))
        if not paths:
            raise RecordingError(f"there are no recordings ({', '.join(ENDINGS)}) in {one}")
    return list(names.values())


def _paths(one: str) -> Iterator[str]:
    if Path(one).is_dir():
        for folder, _folders, names in os.walk(one, onerror=_unreadable):
            chosen = (name for name in names if name.endswith(ENDINGS))
            yield from (str(Path(folder, name)) for name in chosen)
    elif one:
        # Unlike those of `glob`, the `**` of `Path.glob` does not follow symbolic links, which may form loops.
        pattern = Path(one)
        try:
            found = list(Path(pattern.anchor).glob(str(pattern.relative_to(pattern.anchor))))
        except ValueError as error:
            raise RecordingError(f"{one}: {error}") from error
        yield from (str(path) for path in found if not path.is_dir())


def _unreadable(error: OSError) -> None:
    raise RecordingError(f"cannot read the folder {error.filename}: {error.strerror}") from error


def local_recording(path: Path) -> RecordingName:
    uri, place = os.fsencode(path).decode("utf-8", "backslashreplace"), os.fsencode(path.absolute())
    try:
        status = path.stat()
    except OSError:
        return RecordingName(uri, 0, "", place)  # opening it reports the reason
    return RecordingName(uri, status.st_size, str(status.st_mtime_ns), place)
