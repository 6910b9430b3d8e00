"""Run in the virtual machine of the tests: take one order per line from a virtio port, and answer with its outcome.

An order is `{"number", "argv", "seconds"}`, its answer `{"number", "status", "output"}`, both JSON. `{"ready": true}`
is sent once the checkout (a tar archive on the second disk) is unpacked. The program uses only the standard library,
because the project is not there at the start.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

PORT = Path("/dev/virtio-ports/rosrv.agent")
CHECKOUT = Path("/dev/vdb")
LONGEST_OUTPUT = 4 << 20  # bytes


def main() -> None:
    words = Path("/proc/cmdline").read_text(encoding="ascii").split()
    root = next(word.removeprefix("rosrv.root=") for word in words if word.startswith("rosrv.root="))
    Path(root).mkdir(parents=True, exist_ok=True)
    subprocess.run(["tar", "-xf", str(CHECKOUT), "-C", root], check=True)
    with PORT.open("r+b", buffering=0) as port:
        _say(port, {"ready": True})
        while True:
            order = json.loads(_line(port))
            status, output = _run(order["argv"], float(order["seconds"]), root)
            _say(port, {"number": order["number"], "status": status, "output": output})


def _run(argv: list[str], seconds: float, root: str) -> tuple[int, str]:
    environment = {
        "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
        "HOME": "/root",
        "LANG": "C.UTF-8",
        "CI": "true",
        "TESTS_PATIENCE": "4",
    }
    process = subprocess.Popen(
        argv,
        cwd=root,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        output, _ = process.communicate()
        output += f"\nno end in {seconds:.0f} s: killed".encode()
    return process.returncode, output[-LONGEST_OUTPUT:].decode("utf-8", "backslashreplace")


def _line(port: BinaryIO) -> bytes:
    line = b""
    while not line.endswith(b"\n"):
        part = port.read(65536)
        if not part:
            sys.exit("the port is closed: the test has gone")
        line += part
    return line


def _say(port: BinaryIO, what: dict[str, object]) -> None:
    left = json.dumps(what).encode() + b"\n"
    while left:
        left = left[port.write(left) or 0 :]


if __name__ == "__main__":
    main()
