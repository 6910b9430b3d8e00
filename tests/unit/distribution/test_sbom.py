import pytest

from distribution.image import ImageFiles

_TEXT = "usr/share/doc/{}/copyright"


@pytest.fixture
def tree() -> ImageFiles:
    """A tree after one layer, with the licences of two packages, and of a third through a link."""
    made = ImageFiles()
    made.begin_layer()
    for package in ("bash", "curl"):
        made.add(f"./{_TEXT.format(package)}", package.encode())
    made.add("usr/share/doc/libcurl4", b"", link="curl")
    assert [made.copyright(name) for name in ("bash", "curl", "libcurl4")] == ["bash", "curl", "curl"]
    made.begin_layer()
    return made


@pytest.mark.parametrize(
    ("whiteout", "left"),
    [
        ("usr/share/doc/curl/.wh.copyright", ["bash", "", ""]),
        ("usr/share/doc/.wh.curl", ["bash", "", ""]),
        ("usr/share/doc/.wh.cur", ["bash", "curl", "curl"]),
        ("usr/share/doc/.wh.libcurl4", ["bash", "curl", ""]),
        ("./.wh.usr", ["", "", ""]),
        ("usr/share/doc/curl/.wh..wh..opq", ["bash", "", ""]),
        ("usr/share/doc/.wh..wh..opq", ["", "", ""]),
        (".wh..wh..opq", ["", "", ""]),
    ],
)
def test_whiteouts_remove_files_and_links_of_earlier_layers(
    tree: ImageFiles, whiteout: str, left: list[str]
) -> None:
    tree.add(whiteout, b"")
    assert [tree.copyright(name) for name in ("bash", "curl", "libcurl4")] == left


@pytest.mark.parametrize("order", [1, -1], ids=["first", "last"])
def test_an_opaque_folder_keeps_the_files_of_its_own_layer(tree: ImageFiles, order: int) -> None:
    for name in ("usr/share/doc/.wh..wh..opq", _TEXT.format("curl"))[::order]:
        tree.add(name, b"" if ".wh." in name else b"new")
    assert [tree.copyright(name) for name in ("bash", "curl", "libcurl4")] == ["", "new", ""]
