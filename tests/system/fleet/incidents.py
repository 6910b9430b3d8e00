import time
from pathlib import Path

from fleet.tests.support.fleet_site import FleetRobot
from tests.unit.features.evidence.conftest import Control


def incident(robot: FleetRobot, path: Path, bag: bytes = b"") -> Path:
    control = Control(robot.log)
    control.load_policy(7, "[Nodes]\ndefault = *\n")
    control.load_specifications(2, {"a.rv": "a() { }"})
    control.begun = time.time_ns()
    control.work()
    if not bag:
        return control.exported(path)
    return control.export(control.record(robot.folder, bag), path)
