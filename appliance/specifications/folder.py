"""The folder of specifications as it is now, read only when something in it has changed.

Every status and every list of monitors says whether the folder differs from what is in force: that must not cost the
reading of all its files in the loop that decides requests.
"""

from pathlib import Path

from appliance.specifications.specification_files import Sources, SpecificationsRefusedError, read_folder

_Stamp = tuple[str, int, int, int, int]


class SpecificationFolder:
    """What a folder has (None: no folder, no files)."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self._stamps: list[_Stamp] | None = None
        self._found: Sources | None = None

    def read(self) -> Sources:
        """Read all files. Raises `SpecificationsRefusedError`."""
        return read_folder(self.path) if self.path is not None else Sources()

    def looked_at(self) -> Sources | None:
        """What is in it; None if it cannot be used. Nothing is read while all files are as they were."""
        if self.path is None:
            return Sources()
        stamps = _stamps(self.path)
        if stamps is None or stamps != self._stamps:
            try:
                self._found = self.read()
            except SpecificationsRefusedError:
                self._found = None
            self._stamps = stamps
        return self._found


def _stamps(folder: Path) -> list[_Stamp] | None:
    """What changes when a file does; None if that cannot be seen."""
    try:
        paths = [folder, *folder.glob("*.rv*"), *(folder / "msg").rglob("*")]
        return sorted(_stamp(path) for path in paths)
    except OSError:
        return None


def _stamp(path: Path) -> _Stamp:
    about = path.stat()
    return str(path), about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns
