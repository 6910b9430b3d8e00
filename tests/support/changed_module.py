"""A pytest plugin that changes a module before it is loaded, by the JSON of CHANGED: file, old text, new text.

CHANGED='["appliance/x.py", "old", "new"]' pytest -p tests.support.changed_module
"""

import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import CodeType, ModuleType

_FILE, _OLD, _NEW = json.loads(os.environ["CHANGED"])


class _ChangedLoader(importlib.machinery.SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType:
        text = Path(self.path).read_text(encoding="utf-8")
        assert text.count(_OLD) == 1, f"{_FILE} has {text.count(_OLD)} times {_OLD!r}"
        return compile(text.replace(_OLD, _NEW), self.path, "exec")


class _Finder(importlib.abc.MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, _target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if _FILE.removeprefix("fleet/") != f"{fullname.replace('.', '/')}.py":
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path)
        if spec is None or spec.origin is None:
            return None
        return importlib.util.spec_from_loader(
            fullname, _ChangedLoader(fullname, spec.origin), origin=spec.origin
        )


sys.meta_path.insert(0, _Finder())
