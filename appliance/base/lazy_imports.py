"""Import modules on first use, without the cost of a garbage collection."""

import gc
import importlib
import sys
from typing import Any


def load(name: str, prepare: str = "") -> Any:
    """Return the module of this name; on the first call also run its function `prepare`, which fills its caches.

    A module's objects stay for good. A garbage collection over them would cost a tenth of the import, each time.
    """
    if name not in sys.modules:
        gc.disable()
        try:
            module = importlib.import_module(name)
            if prepare:
                getattr(module, prepare)()
        finally:
            gc.freeze()
            gc.enable()
    return sys.modules[name]
