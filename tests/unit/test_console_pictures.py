import hashlib
import json
import re
from pathlib import Path

from appliance import __version__

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "pictures"
AGAIN = "make them again, as root: python -m tests.system.console.pictures"


def test_the_pictures_show_the_version_of_the_tree() -> None:
    """During development those of the last release will do."""
    released = re.findall(r"^## \[(\d[\d.]*)\] - ", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
    expected = {__version__, released} if ".dev" in __version__ else {__version__}
    assert json.loads((PICTURES / "console.json").read_text())["version"] in expected, AGAIN


def test_each_picture_is_of_that_run() -> None:
    listed = json.loads((PICTURES / "console.json").read_text())["pictures"]
    hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in PICTURES.glob("*.png")}
    assert hashes == listed, AGAIN


def test_each_picture_is_on_a_page() -> None:
    pages = "".join(page.read_text() for page in ((ROOT / "README.md"), *(ROOT / "docs").rglob("*.md")))
    assert [path.name for path in PICTURES.iterdir() if f"pictures/{path.name}" not in pages] == [
        "console.json"
    ]
