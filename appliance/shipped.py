"""What comes with the program beside its code: examples, policies, monitors; what Debian has installed."""

import sys
from pathlib import Path

_CHECKOUT = Path(__file__).resolve().parents[1]
# In a checkout its top folder, else where the wheel and the Debian package put them.
IS_CHECKOUT = (_CHECKOUT / "pyproject.toml").exists()
SHIPPED = _CHECKOUT if IS_CHECKOUT else Path(sys.prefix) / "share" / "rosrv"
DPKG = Path("/var/lib/dpkg")
