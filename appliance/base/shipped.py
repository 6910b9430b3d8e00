"""Locate the files that ship with the program (examples, policies, monitors) and dpkg's database."""

import sys
from pathlib import Path

from appliance.base import clock

_CHECKOUT = Path(__file__).resolve().parents[2]
# In a checkout: its top folder, of which a process may see a part only (`private_view.py`). Otherwise: where the wheel
# and the Debian package install the files.
IS_CHECKOUT = (_CHECKOUT / "monitors" / "guards").is_dir()
SHIPPED = _CHECKOUT if IS_CHECKOUT else Path(sys.prefix) / "share" / "rosrv"
DPKG = Path("/var/lib/dpkg")
_DAY = 86_400.0


def before_program() -> float:
    """Return the seconds that the system clock is behind the program's files; 0 for less than a day."""
    before = _date_of_program() - clock.wall()
    return before if before > _DAY else 0.0


def earliest_now() -> float:
    """Return the system time, or the date of the program's files if the clock is behind them: it is not set yet.

    A certificate that is made until the time service answers would otherwise have ended long ago once it does.
    """
    return clock.wall() + before_program()


def certainly_past() -> float:
    """Return the date of the program's files, or the system time if the clock is behind them.

    A certificate that begins then is also valid once a clock that was ahead is set.
    """
    return min(clock.wall(), _date_of_program())


def _date_of_program() -> float:
    return Path(__file__).stat().st_mtime
