// What a relay costs at least: one connection in, one out, no grants, no control, nothing recorded.
//
//   copying_relay [epoll] PORT
//
// `epoll`: it asks before each read whether there is something, as one must that has more than two connections. Prints
// the port it listens on, takes one subscriber, connects to the publisher at PORT, passes on both connection headers
// and then the messages. Each is looked at as a monitor would: of the fixed part of relay_load/Sample it reads
// `number` and `value`, writes `value` and steps a machine of two states; the rest is streamed, as it arrives.
#include <arpa/inet.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

enum { BUFFER = 1 << 18, HEAD = 28 };

static void fail(const char *what) {
  perror(what);
  exit(1);
}

static void send_all(int to, const char *data, size_t size) {
  while (size) {
    ssize_t sent = send(to, data, size, MSG_NOSIGNAL);
    if (sent <= 0) exit(0);  // the load is over
    data += sent;
    size -= sent;
  }
}

static void receive_all(int from, char *data, size_t size) {
  while (size) {
    ssize_t got = recv(from, data, size, 0);
    if (got <= 0) fail("connection header");
    data += got;
    size -= got;
  }
}

static void pass_header(int from, int to) {
  static char header[1 << 16];
  uint32_t size;
  receive_all(from, (char *)&size, 4);
  if (size > sizeof header) fail("connection header too long");
  receive_all(from, header, size);
  send_all(to, (char *)&size, 4);
  send_all(to, header, size);
}

static void tune(int fd) {
  int on = 1;
  setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
  setsockopt(fd, IPPROTO_TCP, TCP_CONGESTION, "cubic", 5);
}

static void look_at(char *frame) {
  static int state = 0;
  uint64_t number;
  double value;
  memcpy(&number, frame + 4, 8);
  memcpy(&value, frame + 20, 8);
  if (value > 0.5) value = (double)(number % 2) / 2;
  memcpy(frame + 20, &value, 8);
  state = !state;
}

static int watch(int fd) {
  struct epoll_event wanted = {.events = EPOLLIN};
  int watching = epoll_create1(0);
  if (watching < 0 || epoll_ctl(watching, EPOLL_CTL_ADD, fd, &wanted)) fail("epoll");
  return watching;
}

static void relay(int from, int to, int watching) {
  static char buffer[BUFFER];
  struct epoll_event found[16];
  size_t kept = 0, rest = 0;  // bytes of a head that is not whole yet; bytes of a message still to come
  for (;;) {
    if (watching >= 0 && epoll_wait(watching, found, 16, -1) < 0) fail("epoll_wait");
    ssize_t got = recv(from, buffer + kept, BUFFER - kept, 0);
    if (got <= 0) return;
    size_t filled = kept + got, at = 0;
    for (;;) {
      size_t part = rest < filled - at ? rest : filled - at;
      at += part;
      rest -= part;
      if (filled - at < HEAD) break;
      uint32_t length;
      memcpy(&length, buffer + at, 4);
      look_at(buffer + at);
      rest = 4 + (size_t)length;
    }
    send_all(to, buffer, at);
    kept = filled - at;
    memmove(buffer, buffer + at, kept);
  }
}

int main(int argc, char **argv) {
  struct sockaddr_in here = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
  socklen_t size = sizeof here;
  if (argc != 2 && argc != 3) return 2;
  int listening = socket(AF_INET, SOCK_STREAM, 0);
  if (bind(listening, (struct sockaddr *)&here, size) || listen(listening, 1)) fail("listen");
  getsockname(listening, (struct sockaddr *)&here, &size);
  printf("%d\n", ntohs(here.sin_port));
  fflush(stdout);
  int subscriber = accept(listening, NULL, NULL), publisher = socket(AF_INET, SOCK_STREAM, 0);
  here.sin_port = htons(atoi(argv[argc - 1]));
  if (connect(publisher, (struct sockaddr *)&here, sizeof here)) fail("connect");
  tune(subscriber);
  tune(publisher);
  pass_header(subscriber, publisher);
  pass_header(publisher, subscriber);
  relay(publisher, subscriber, argc == 3 ? watch(publisher) : -1);
  return 0;
}
