import json
import subprocess
from pathlib import Path
from typing import Any

from tests.support.nodes import BUILD, PYTHON, ROOT, RosSession
from tests.support.processes import Process

HERE = Path(__file__).parent


def rospy_node(ros: RosSession, program: str, name: str, *arguments: str, **environment: str) -> Process:
    command = [PYTHON, str(HERE / "rospy_nodes" / f"{program}.py"), *arguments, f"__name:={name}"]
    process = ros.start(command, label=f"rospy {program}", **environment)
    process.wait_for(event="ready")
    return process


def roscpp_node(ros: RosSession, program: str, name: str, *arguments: str) -> Process:
    target = BUILD / program
    source = HERE / "roscpp_nodes" / f"{program}.cpp"
    subprocess.run([str(ROOT / "scripts" / "build-roscpp"), str(source), str(target)], check=True)
    process = ros.start([str(target), *arguments, f"__name:={name}"], label=f"roscpp {program}")
    process.wait_for(event="ready")
    return process


def order(node: Process, do: str, **told: Any) -> dict[str, Any]:
    mark = node.mark()
    node.send(json.dumps({"do": do, **told}))
    return node.wait_for(event="done", do=do, since=mark)
