"""A graph of three computers, as a survey reads it."""

from appliance.rpc.graph_inventory import (
    GraphInventory,
    NodeConnection,
    OpenPort,
    SurveyedNode,
    SurveyedService,
    SurveyedTopic,
)

BASE, ARM, TABLET = "10.0.0.1", "10.0.0.2", "10.0.0.7"


def node(
    name: str, host: str, problem: str = "", connections: tuple[NodeConnection, ...] = ()
) -> SurveyedNode:
    return SurveyedNode(name, f"http://{host}:4000/", host, 1, problem, connections)


NODES = (
    node("/arm/driver", ARM),
    node("/arm/planner", ARM),
    node("/base", BASE),
    node("/camera", BASE),
    node("/navigation", BASE),
    node("/rviz_1700000000000", TABLET),
    node("/teleop", TABLET),
)
TOPICS = (
    SurveyedTopic(
        "/arm/command", "trajectory_msgs/JointTrajectory", ("/arm/planner",), ("/arm/driver",), 4.0
    ),
    SurveyedTopic("/arm/state", "sensor_msgs/JointState", ("/arm/driver",), ("/rviz_1700000000000",), 50.0),
    SurveyedTopic("/camera/image", "sensor_msgs/Image", ("/camera",), ("/rviz_1700000000000",), 30.0),
    SurveyedTopic("/cmd_vel", "geometry_msgs/Twist", ("/navigation", "/teleop"), ("/base",), 20.0),
    SurveyedTopic("/odom", "nav_msgs/Odometry", ("/base",), ("/navigation", "/rviz_1700000000000"), 20.0),
    SurveyedTopic("/scan", "sensor_msgs/LaserScan", ("/base",), ("/navigation",), 10.0),
)
SERVICES = (
    SurveyedService("/arm/enable", ("/arm/driver",)),
    SurveyedService("/arm/get_loggers", ("/arm/driver",)),
    SurveyedService("/base/reset", ("/base",)),
)


def inventory(**changes: object) -> GraphInventory:
    fields: dict[str, object] = {
        "master": "http://base:11311", "master_host": BASE, "nodes": NODES, "topics": TOPICS, "services": SERVICES,
        "parameters": ("/base/wheel", "/wifi/password"), "listeners": (OpenPort(BASE, 11311, "a ROS master"),),
        "calls": 40, "seconds": 1.2,
    }  # fmt: skip
    return GraphInventory(**(fields | changes))  # type: ignore[arg-type]  # fields by name
