import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from tests.support.sources import ROOT


@contextmanager
def changed_product(changes: Mapping[str, tuple[str, str]]) -> Iterator[Path]:
    """Copy the product, with a text of each file of `appliance` replaced: its PYTHONPATH."""
    folder = Path(tempfile.mkdtemp())  # the users of its processes cannot enter pytest's folder
    folder.chmod(0o755)
    try:
        for name in ("appliance", "rosmop", "roswire", "monitors"):
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "tests"))
        for name, (old, new) in changes.items():
            file = folder / "appliance" / name
            text = file.read_text()
            assert old in text, name
            file.write_text(text.replace(old, new))
        yield folder
    finally:
        shutil.rmtree(folder)
