"""What comes with the program beside its code: examples, policies, monitors; what Debian has installed."""

import sys
import time
from pathlib import Path

_CHECKOUT = Path(__file__).resolve().parents[2]
# In a checkout its top folder, else where the wheel and the Debian package put them.
IS_CHECKOUT = (_CHECKOUT / "pyproject.toml").exists()
SHIPPED = _CHECKOUT if IS_CHECKOUT else Path(sys.prefix) / "share" / "rosrv"
DPKG = Path("/var/lib/dpkg")
_DAY = 86_400.0


def before_program() -> float:
    """How many seconds the machine's clock stands before this program was made, by its files; 0: less than a day."""
    before = Path(__file__).stat().st_mtime - time.time()
    return before if before > _DAY else 0.0
