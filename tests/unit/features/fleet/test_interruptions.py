import os
import resource
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from appliance.features.fleet.verified_bundles import BundleFolderError, BundleRejectedError, VerifiedBundles
from tests.unit.features.fleet.robot_site import RobotSite

pytestmark = pytest.mark.nightly

_KILLED, _DONE, _FULL = 9, 0, 7


@pytest.fixture
def site(tmp_path: Path) -> Iterator[tuple[RobotSite, str]]:
    site = RobotSite(tmp_path / "site")
    site.add()
    with site.served() as url:
        poll(site.robot(url, tmp_path / "robot"))
        yield site, url


def poll(robot: VerifiedBundles) -> str:
    robot.refresh()
    selected = robot.fetch_selected()
    assert selected is not None
    return str(robot.get(selected).path)


def in_child(work: Callable[[], None]) -> int:
    child = os.fork()
    if not child:
        try:
            work()
            os._exit(_DONE)
        except BundleFolderError:
            os._exit(_FULL)
        except BaseException:  # noqa: BLE001  the child may not return into pytest
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_at(step: int, folder: Path) -> None:
    left = [step]

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event in ("open", "os.rename", "os.remove", "os.mkdir", "os.symlink") and str(folder) in str(
            arguments[0]
        ):
            left[0] -= 1
            if left[0] < 0:
                os._exit(_KILLED)

    sys.addaudithook(hook)


def test_a_kill_at_any_step_loses_nothing(site: tuple[RobotSite, str], tmp_path: Path) -> None:
    served, url = site
    old = served.timestamp
    step = 0
    while True:
        path = served.add()
        new = served.timestamp
        robot = served.robot(url, tmp_path / "robot")

        def work(robot: VerifiedBundles = robot, step: int = step) -> None:
            killed_at(step, tmp_path / "robot")
            poll(robot)

        status = in_child(work)
        assert status in (_KILLED, _DONE)
        assert poll(served.robot(url, tmp_path / "robot")) == str(path)
        served.timestamp = old
        with pytest.raises(BundleRejectedError, match="version"):
            poll(served.robot(url, tmp_path / "robot"))
        served.timestamp = old = new
        if status == _DONE:
            break
        step += 3
    assert step > 15


def test_a_full_disk_is_reported_and_passes(site: tuple[RobotSite, str], tmp_path: Path) -> None:
    served, url = site
    path = served.add()
    robot = served.robot(url, tmp_path / "robot")

    def work() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (200, 200))
        poll(robot)

    assert in_child(work) == _FULL
    assert poll(served.robot(url, tmp_path / "robot")) == str(path)
    assert not list((tmp_path / "robot").rglob("tmp*"))
