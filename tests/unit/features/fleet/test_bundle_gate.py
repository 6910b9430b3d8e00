import msgspec
import pytest

from appliance.features.fleet.bundle_gate import disabled_among
from appliance.features.fleet.bundle_link import BundleLink, BundleOffered
from appliance.formats.bundle_archive import HOSTS, POLICY, BundleArchiveError, BundleContents, contents_of
from appliance.specifications.specification_files import CheckedSpecifications
from appliance.specifications.switches import Switches


@pytest.mark.parametrize(
    ("enable", "end"),
    [
        ("all", ""),
        ("shadow", ""),
        ("zone", "; disabled on this robot: fence (rosrv monitor enable)"),
        ("none", "; disabled on this robot: fence, zone (rosrv monitor enable)"),
    ],
)
def test_the_record_of_a_bundle_names_the_monitors_that_do_nothing(enable: str, end: str) -> None:
    checked = CheckedSpecifications(monitors={"fence": "fence.rv", "zone": "zone.rv"})
    assert disabled_among(Switches(enable).of(checked).states) == end


NAMES = ["a.rv", "A_.b-c.rv", "p/T.msg", "p/T.srv", "msg/p/T.msg", "p/T.rv", "../a.rv", "/a.rv", ".rv", "a.rv\n",
    "p/T.msg\n", "a.rv.sig", "", "policy.ini", "a/b/T.msg", "a\0.rv"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("part", ["files", "definitions"])
def test_control_takes_only_the_names_that_an_archive_may_have(name: str, part: str) -> None:
    """The process that reads archives may be compromised."""
    try:
        folder = "monitors/" if part == "files" else "monitors/msg/"
        read = contents_of({POLICY: b"", HOSTS: b"", folder + name: b""})
        expected = name in getattr(read, part)
    except BundleArchiveError:
        expected = False
    contents = msgspec.structs.replace(BundleContents("", ""), **{part: {name: ""}})
    offered = BundleOffered("s/g/1.tar", "", contents)
    try:
        taken = msgspec.msgpack.decode(msgspec.msgpack.encode(offered), type=BundleLink)
    except msgspec.ValidationError:
        taken = None
    assert (taken is not None) == expected
    assert taken in (None, offered)
