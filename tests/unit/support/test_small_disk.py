from tests.support.sources import ROOT

ELSEWHERE = {
    "tests/support/small_disk.py",
    "tests/integration/features/standby/test_robot_kit.py",  # in the mount namespace of a host, and ends with it
    "tests/package/test_audit_page.py",  # detaches its own, with what late processes have open
    "tests/package/test_arm64_machine.py",  # binfmt_misc, for the programs of another processor
    "tests/unit/support/test_small_disk.py",
}


def test_only_small_disk_mounts() -> None:
    """An ordinary `umount` fails if a process that was just killed still has a file open."""
    found = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "tests").rglob("*.py")
        if '"mount"' in path.read_text()
    }
    assert found == ELSEWHERE
