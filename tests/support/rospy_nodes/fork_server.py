"""Load rospy in Debian's Python, and fork for each program that `tests/support/forks.py` orders.

An order has the program, its environment and folder, and five descriptors: standard input, output and error, the
network namespace, and a socket for its process id and later its exit status.
"""

import contextlib
import ctypes
import gc
import importlib
import json
import os
import runpy
import selectors
import socket
import sys
from pathlib import Path

import rospy

STOCK_TOOLS = ("rosbag", "rosmaster.main", "rosnode", "rosparam", "rosservice", "rostopic")
LOADED = (*STOCK_TOOLS, "actionlib.msg", "std_srvs.srv")  # besides rospy
LONGEST = 1 << 20  # bytes of an order
CLONE_NEWNET = 0x40000000


def serve(orders):
    with selectors.PollSelector() as selector:
        selector.register(orders, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.fileobj is orders:
                    order, descriptors, *_ = socket.recv_fds(orders, LONGEST, 5)
                    if not order:
                        sys.exit()
                    report = socket.socket(fileno=descriptors.pop())
                    pid = os.fork()
                    if not pid:
                        orders.close()
                        for other in selector.get_map().values():
                            if other.fileobj is not orders:  # of another fork, which is still running
                                os.close(other.fileobj)
                                other.data[1].close()
                        return json.loads(order), descriptors, report
                    for descriptor in descriptors:
                        os.close(descriptor)
                    selector.register(os.pidfd_open(pid), selectors.EVENT_READ, (pid, report))
                else:
                    pid, report = key.data
                    selector.unregister(key.fileobj)
                    os.close(key.fileobj)
                    _, status = os.waitpid(pid, 0)
                    with contextlib.suppress(BrokenPipeError):  # if nothing waits for it any more
                        report.send(str(os.waitstatus_to_exitcode(status)).encode())
                    report.close()


def become(order, descriptors, report):
    *standard, namespace = descriptors
    elsewhere = os.fstat(namespace).st_ino != Path("/proc/self/ns/net").stat().st_ino
    if elsewhere and ctypes.CDLL(None, use_errno=True).setns(namespace, CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "the network namespace cannot be entered")
    os.close(namespace)
    for number, descriptor in enumerate(standard):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.setsid()
    report.send(str(os.getpid()).encode())
    report.close()
    os.chdir(order["folder"])
    os.environ.clear()
    os.environ.update(order["environment"])
    sys.argv[:] = order["arguments"]  # changed in place: rosmaster keeps a reference to it
    importlib.reload(rospy.names)  # arguments and environment that rospy reads as it is loaded


def main():
    for module in LOADED:
        importlib.import_module(module)
    gc.freeze()  # keep loaded objects out of collections, so that their pages are not copied
    become(*serve(socket.socket(fileno=int(sys.argv[1]))))
    if sys.argv[0] == "-c":
        program = sys.argv.pop(1)
        sys.path[0] = ""
        exec(compile(program, "<string>", "exec"), {"__name__": "__main__"})  # noqa: S102  as ordered
    else:
        sys.path[0] = str(Path(sys.argv[0]).resolve().parent)
        runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
