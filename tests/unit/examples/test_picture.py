import re
from pathlib import Path
from xml.etree import ElementTree

from examples.landshark.drive import SHIPPED, Simulation
from examples.landshark.nodes import physics
from examples.landshark.picture import draw

PICTURE = Path(__file__).parents[3] / "docs" / "pictures" / "landshark-drive.svg"


def test_the_picture_states_the_measured_facts() -> None:
    """If this fails, draw it again: `python -m examples.landshark.drive --svg docs/pictures/landshark-drive.svg`."""
    without, guarded = Simulation().run(), Simulation(SHIPPED).run()
    drawn = draw(without, guarded)
    shipped = PICTURE.read_text(encoding="utf-8")
    assert words(drawn) == words(shipped)
    said = " ".join(words(shipped))
    assert f"out of the yard, {without.farthest():.1f} m from the origin" in said
    assert f"half a second: {guarded.farthest():.1f} m from the origin" in said
    assert f"speed to 0 {guarded.nearest(physics.YARD[0]):.2f} m before it" in said
    assert without.nearest(physics.YARD[0]) < 0 < guarded.nearest(physics.YARD[0])
    assert [len(track) > 50 for track in tracks(shipped)] == [True] * 3, "two ways and the angle of the gun"


def words(svg: str) -> list[str]:
    return [one.text or "" for one in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]  # noqa: S314  our own text


def tracks(svg: str) -> list[list[str]]:
    return [points.split() for points in re.findall(r'<polyline [^>]*points="([^"]*)"', svg)]
