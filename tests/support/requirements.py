"""Skip a test with a missing requirement on a laptop, and fail it in CI, so that no test silently stops running."""

import os
import shutil

import pytest

from appliance.network.namespaces import has_privileges


def needs(condition: object, text: str) -> None:
    if condition:
        return
    if os.environ.get("CI", "").lower() in ("1", "true", "yes"):
        pytest.fail(f"needs {text}, which this CI machine lacks", pytrace=False)
    pytest.skip(f"needs {text}")


def need_root() -> None:
    needs(has_privileges(), "root (CAP_SYS_ADMIN and CAP_NET_ADMIN): run the tests with sudo")


def need_program(name: str, package: str) -> str:
    path = shutil.which(name)
    needs(path, f"`{name}` (Debian: sudo apt install {package})")
    return path or ""
