"""Modules that are imported when they are first needed, as those of a process's start are."""

import gc
import importlib
import sys
from typing import Any


def load(name: str, prepare: str = "") -> Any:
    """The module of this name, after its function `prepare` has made what each later call would.

    What a module makes stays: looking through it for garbage would be a tenth of its import, and of each later look.
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
