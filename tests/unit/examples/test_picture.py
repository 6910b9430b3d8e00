"""The picture in the documentation is what the simulation does."""

from pathlib import Path
from xml.etree import ElementTree

from examples.landshark.drive import SHIPPED, Simulation
from examples.landshark.picture import draw

PICTURE = Path(__file__).parents[3] / "docs" / "pictures" / "landshark-drive.svg"


def test_the_picture_is_up_to_date() -> None:
    """Drawn again from the shipped monitors, it is the same file: `python -m examples.landshark.drive --svg …`."""
    drawn = draw(Simulation().run(), Simulation(SHIPPED).run())
    assert drawn == PICTURE.read_text(encoding="utf-8")
    root = ElementTree.fromstring(drawn)  # noqa: S314  our own text
    tracks = [one for one in root if one.tag.endswith("polyline")]
    assert len(tracks) == 3
