"""The message types that guards know, by the roles of topics in the language."""

from rosmop.types.roles import types_of_roles

_ROLES = types_of_roles()
VELOCITIES = _ROLES["Velocity"]
TRAJECTORIES = _ROLES["Trajectory"]
GOALS = _ROLES["Goal"]
COMMANDS = _ROLES["Command"]
RESULTS = _ROLES["Result"]
POSES = _ROLES["Pose"]
SCANS = _ROLES["Scan"]
BATTERIES = _ROLES["Battery"]
VALUED = tuple(kind for kind in _ROLES["Sensor"] if "/" in kind)
"""The sensors whose values are judged; of all others, only the silence is."""
GOAL = "control_msgs/FollowJointTrajectoryActionGoal"
