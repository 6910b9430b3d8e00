"""Relay one connection with five lines of Python that never parse a message: `copying_relay.py PORT`.

Like `copying_relay.c`, it prints its port, takes one subscriber, connects to the publisher at PORT, and passes on
both connection headers before the messages.
"""

import select
import socket
import struct
import sys


def tuned(sock):
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"cubic")
    return sock


def pass_header(source, target):
    size = source.recv(4, socket.MSG_WAITALL)
    target.sendall(size + source.recv(*struct.unpack("<I", size), socket.MSG_WAITALL))


def main():
    listening = socket.create_server(("127.0.0.1", 0))
    print(listening.getsockname()[1], flush=True)
    subscriber = tuned(listening.accept()[0])
    publisher = tuned(socket.create_connection(("127.0.0.1", int(sys.argv[1]))))
    pass_header(subscriber, publisher)
    pass_header(publisher, subscriber)
    watching, buffer = select.epoll(), memoryview(bytearray(1 << 18))
    watching.register(publisher, select.EPOLLIN)
    try:
        while watching.poll(-1, 16) and (size := publisher.recv_into(buffer)):
            subscriber.sendall(buffer[:size])
    except ConnectionError:
        pass  # the load is over


if __name__ == "__main__":
    main()
