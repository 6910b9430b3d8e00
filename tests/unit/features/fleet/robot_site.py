import time
from collections.abc import Callable
from pathlib import Path

from appliance.features.fleet.connection import CollectorConnection, robot_connection
from appliance.features.fleet.verified_bundles import VerifiedBundles
from fleet.tests.support.bundle_site import GROUP, ROBOT, SITE, BundleSite


class RobotSite(BundleSite):
    def connection(self, url: str, robot: str = ROBOT) -> CollectorConnection:
        certificate, key = self.authority.issue(robot)
        made = robot_connection(url, self.authority.ca, certificate, key)
        self.connections.append(made)
        return made

    def robot(
        self, url: str, folder: Path, robot: str = ROBOT, clock: Callable[[], float] = time.time
    ) -> VerifiedBundles:
        connection = self.connection(url, robot)
        return VerifiedBundles(
            folder, self.first_root, connection, site=SITE, group=GROUP, robot=robot, clock=clock
        )
