"""Drive through a door with roslibpy, as an agent does: drive.py HOST PORT. It publishes ten times a second."""

import sys
import threading

import roslibpy

ros = roslibpy.Ros(host=sys.argv[1], port=int(sys.argv[2]))
ros.run(timeout=20)
base = roslibpy.Topic(ros, "/cmd_vel", "geometry_msgs/Twist")
pause = threading.Event()
while ros.is_connected:
    base.publish(
        roslibpy.Message({"linear": {"x": 0.3, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0}})
    )
    pause.wait(0.1)
ros.terminate()
