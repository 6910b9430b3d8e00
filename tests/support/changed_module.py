"""A pytest plugin that changes a module before any other loads it, by the JSON of CHANGED: file, old text, new text.

CHANGED='["appliance/x.py", "old", "new"]' pytest -p tests.support.changed_module
"""

import importlib.util
import json
import os
import sys
from pathlib import Path

_FILE, _OLD, _NEW = json.loads(os.environ["CHANGED"])
_NAME = _FILE.removeprefix("fleet/src/").removesuffix(".py").replace("/", ".")
_SPEC = importlib.util.find_spec(_NAME)
assert _SPEC is not None
assert _SPEC.origin is not None
assert _NAME not in sys.modules, f"{_NAME} is loaded already"
_TEXT = Path(_SPEC.origin).read_text(encoding="utf-8")
assert _TEXT.count(_OLD) == 1, f"{_FILE} has {_TEXT.count(_OLD)} times {_OLD!r}"
_MODULE = sys.modules[_NAME] = importlib.util.module_from_spec(_SPEC)
exec(compile(_TEXT.replace(_OLD, _NEW), _SPEC.origin, "exec"), _MODULE.__dict__)  # noqa: S102  our own text
setattr(sys.modules[_NAME.rpartition(".")[0]], _NAME.rpartition(".")[2], _MODULE)
