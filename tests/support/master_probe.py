"""Ask appliances 20 times a second whether they answer as a ROS master, until the input ends.

    master_probe.py NAME=URI...

The event `answered` has the name. Refused and late calls are not reported.
"""

import http.client
import json
import sys
import threading
import urllib.parse

_PAUSE, _SECONDS = 0.05, 0.5
_BODY = (
    "<methodCall><methodName>getUri</methodName>"
    "<params><param><value>/probe</value></param></params></methodCall>"
)
_ended = threading.Event()


def ask(name: str, uri: str) -> None:
    place = urllib.parse.urlsplit(uri)
    while not _ended.wait(_PAUSE):
        connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=_SECONDS)
        try:
            connection.request("POST", "/RPC2", _BODY, {"Content-Type": "text/xml"})
            connection.getresponse().read()
        except (OSError, http.client.HTTPException):
            continue
        finally:
            connection.close()
        sys.stdout.write(json.dumps({"event": "answered", "by": name}) + "\n")
        sys.stdout.flush()


def main() -> None:
    for given in sys.argv[1:]:
        threading.Thread(target=ask, args=given.split("=", 1), daemon=True).start()
    sys.stdin.read()
    _ended.set()


if __name__ == "__main__":
    main()
