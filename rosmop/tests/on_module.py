from collections.abc import Collection

from rosmop.fast.build import fast_path_of
from rosmop.form.compiled import Compiled
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import OnFault


def on_module(compiled: Compiled, on_fault: OnFault = "drop", shadows: Collection[str] = ()) -> MonitorSet:
    return MonitorSet.of(compiled, on_fault, fast=fast_path_of(compiled.without(shadows)), shadows=shadows)
