"""The picture in the documentation matches the simulation."""

from pathlib import Path
from xml.etree import ElementTree

from examples.landshark.drive import SHIPPED, Simulation
from examples.landshark.picture import draw

PICTURE = Path(__file__).parents[3] / "docs" / "pictures" / "landshark-drive.svg"


def test_the_picture_is_up_to_date() -> None:
    """The shipped monitors draw the same file again: `python -m examples.landshark.drive --svg …`."""
    drawn = draw(Simulation().run(), Simulation(SHIPPED).run())
    assert drawn == PICTURE.read_text(encoding="utf-8")
    root = ElementTree.fromstring(drawn)  # noqa: S314  our own text
    tracks = [one for one in root if one.tag.endswith("polyline")]
    assert len(tracks) == 3
