"""Use a door with roslibpy as a program does, and print one JSON object a line: client.py HOST PORT TOPIC...

It publishes on the topics ten times a second, and roslibpy advertises each of them once. It calls the two services.
"""

import json
import logging
import sys
import threading

import roslibpy


def say(**what: object) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


class Log(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        say(event="logged", text=record.getMessage())


def call(ros: roslibpy.Ros, name: str) -> None:
    service = roslibpy.Service(ros, name, "std_srvs/SetBool")
    try:
        answer = service.call(roslibpy.ServiceRequest({"data": True}), timeout=20)
        say(event="answered", service=name, **answer)
    except roslibpy.core.ServiceException as error:
        say(event="not answered", service=name, error=str(error))


logging.getLogger("roslibpy").addHandler(Log())
logging.getLogger("roslibpy").setLevel(logging.INFO)
ros = roslibpy.Ros(host=sys.argv[1], port=int(sys.argv[2]))
ros.run(timeout=20)
roslibpy.Topic(ros, "/chatter", "std_msgs/String").subscribe(
    lambda message: say(event="heard", data=message["data"])
)
for name in ("/brake", "/forbidden_brake"):
    threading.Thread(target=call, args=(ros, name), daemon=True).start()
pause = threading.Event()
topics = [roslibpy.Topic(ros, name, "std_msgs/String") for name in sys.argv[3:]]
while ros.is_connected:
    for topic in topics:
        topic.publish(roslibpy.Message({"data": f"to {topic.name}"}))
    pause.wait(0.1)
say(event="closed")
ros.terminate()
