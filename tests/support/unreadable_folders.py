import errno
import os
from pathlib import Path
from typing import Any

import pytest


def make_unreadable(folder: Path, patch: pytest.MonkeyPatch) -> None:
    def refusing(listed: Any) -> Any:
        def list_folder(path: Any = ".") -> Any:
            listed_folder = Path(f"/proc/self/fd/{path}").readlink() if isinstance(path, int) else path
            if Path(os.fsdecode(listed_folder)) == folder:
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return listed(path)

        return list_folder

    patch.setattr(os, "scandir", refusing(os.scandir))
    patch.setattr(os, "listdir", refusing(os.listdir))
