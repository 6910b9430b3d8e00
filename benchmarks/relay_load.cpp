// A TCPROS publisher of relay_load/Sample and a subscriber in one program, for measuring what is between them (no ROS
// needed).
//
//   relay_load BYTES SECONDS flat|window|paced|pacedN [MD5SUM]
//
// Prints the publisher's port. Reads one line, "PORT TOPIC [PID]": where the subscriber connects, and the process in
// the middle. The publisher sends markers until one has come through, then runs: as fast as it can, with at most 64
// messages on their way, 1,000 messages a second, or N. Prints one JSON object: messages a second, lost, out of order,
// the delay in microseconds (median and 99th percentile), and the processor time of all threads of PID meanwhile.
#include <arpa/inet.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

using Fields = std::map<std::string, std::string>;
constexpr uint64_t MARKER = ~0ull;
constexpr uint64_t WINDOW = 64;
constexpr size_t FIXED = 32;  // of a frame of relay_load/Sample (nodes/msg), without its data

int64_t now() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

double cpu_us(pid_t pid) {
  clockid_t clock;
  timespec used{};
  if (pid && (clock_getcpuclockid(pid, &clock) || clock_gettime(clock, &used))) throw std::runtime_error("no such PID");
  return used.tv_sec * 1e6 + used.tv_nsec / 1e3;
}

void write_all(int fd, const char* data, size_t size) {
  while (size) {
    ssize_t sent = send(fd, data, size, MSG_NOSIGNAL);
    if (sent <= 0) throw std::runtime_error("the connection is gone");
    data += sent, size -= sent;
  }
}

void read_all(int fd, char* data, size_t size) {
  while (size) {
    ssize_t got = recv(fd, data, size, 0);
    if (got <= 0) throw std::runtime_error("the connection is gone");
    data += got, size -= got;
  }
}

void append_length(std::string& out, uint32_t length) { out.append(reinterpret_cast<char*>(&length), 4); }

void write_header(int fd, const Fields& fields) {
  std::string body, out;
  for (const auto& [name, value] : fields) {
    append_length(body, name.size() + 1 + value.size());
    body += name + "=" + value;
  }
  append_length(out, body.size());
  out += body;
  write_all(fd, out.data(), out.size());
}

Fields read_header(int fd) {
  uint32_t size, length;
  read_all(fd, reinterpret_cast<char*>(&size), 4);
  std::string body(size, 0);
  read_all(fd, body.data(), size);
  Fields fields;
  for (size_t at = 0; at + 4 <= size; at += length) {
    std::memcpy(&length, &body[at], 4);
    at += 4;
    const std::string field = body.substr(at, length);
    fields[field.substr(0, field.find('='))] = field.substr(field.find('=') + 1);
  }
  return fields;
}

void tune(int fd) {
  int on = 1;
  setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
  setsockopt(fd, IPPROTO_TCP, TCP_CONGESTION, "cubic", 5);
}

struct Load {
  size_t frame;
  double seconds;
  std::string mode, md5sum = "e603182a04880972f86c550eadc3cb3a";
  std::atomic<bool> primed{false}, ended{false};
  std::atomic<uint64_t> received{0};
  uint64_t sent = 0, lost = 0, disordered = 0;
  int64_t first = 0, last = 0;
  pid_t pid = 0;
  double hertz = 0, cpu_before = 0, cpu_after = 0;
  std::vector<int64_t> delays;

  void publish(int listening) {
    int fd = accept(listening, nullptr, nullptr);
    tune(fd);
    const Fields asked = read_header(fd);
    write_header(fd, {{"callerid", "/load"}, {"latching", "0"}, {"md5sum", md5sum},
                      {"message_definition", "uint64 number\nint64 sent\nfloat64 value\nuint8[] data\n"},
                      {"topic", asked.at("topic")}, {"type", "relay_load/Sample"}});
    const size_t batch = hertz ? 1 : std::max<size_t>(1, 262144 / frame);
    std::vector<char> buffer(batch * frame);
    const auto stamp = [&](size_t slot, uint64_t number) {
      const uint32_t length = frame - 4, rest = frame - FIXED;
      const int64_t time = now();
      const double value = 1;
      char* at = &buffer[slot * frame];
      std::memcpy(at, &length, 4), std::memcpy(at + 4, &number, 8), std::memcpy(at + 12, &time, 8);
      std::memcpy(at + 20, &value, 8), std::memcpy(at + 28, &rest, 4);
    };
    const auto mark_until = [&](std::atomic<bool>& seen) {
      while (!seen) {
        stamp(0, MARKER);
        write_all(fd, buffer.data(), frame);
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
      }
    };
    mark_until(primed);
    cpu_before = cpu_us(pid);
    const int64_t start = now(), end = start + int64_t(seconds * 1e9);
    uint64_t given_up = 0, seen = 0;
    int64_t progress = start;
    for (int64_t t = start; t < end; t = now()) {
      size_t count = batch;
      if (mode == "window") {
        const uint64_t got = received;
        if (got != seen) seen = got, progress = t;
        const uint64_t flying = sent - std::min(sent, got + given_up);
        if (flying >= WINDOW) {
          if (t - progress > 300'000'000) given_up += flying, progress = t;  // they were dropped
          std::this_thread::yield();
          continue;
        }
        count = std::min<size_t>(count, WINDOW - flying);
      } else if (hertz) {
        std::this_thread::sleep_until(std::chrono::steady_clock::time_point(std::chrono::nanoseconds(start + int64_t(sent * 1e9 / hertz))));
      }
      for (size_t slot = 0; slot < count; ++slot) stamp(slot, sent + slot);
      write_all(fd, buffer.data(), count * frame);
      sent += count;
    }
    try {
      mark_until(ended);
    } catch (const std::exception&) {
      if (!ended) throw;  // else the subscriber has its marker and left in the middle of the next one
    }
    close(fd);
  }

  void message(const char* at, int64_t t) {
    uint64_t number;
    int64_t time;
    std::memcpy(&number, at + 4, 8), std::memcpy(&time, at + 12, 8);
    if (number == MARKER) {
      if (received) cpu_after = cpu_us(pid);
      (received ? ended : primed) = true;
      return;
    }
    if (!received) first = t;
    static uint64_t next = 0;
    if (number > next) lost += number - next;
    if (number < next) ++disordered;
    next = std::max(next, number + 1);
    last = t;
    if ((received & 63) == 0 || hertz) delays.push_back(t - time);
    received.store(received + 1, std::memory_order_release);
  }

  void subscribe(int port, const std::string& topic) {
    int fd = socket(AF_INET, SOCK_STREAM, 0);
    sockaddr_in where{};
    where.sin_family = AF_INET, where.sin_port = htons(port), where.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (connect(fd, reinterpret_cast<sockaddr*>(&where), sizeof where)) throw std::runtime_error("cannot connect");
    tune(fd);
    write_header(fd, {{"callerid", "/load_listener"}, {"md5sum", "*"}, {"type", "*"}, {"topic", topic}, {"tcp_nodelay", "1"}});
    const Fields header = read_header(fd);
    if (header.count("error")) throw std::runtime_error(header.at("error"));
    std::vector<char> buffer(std::max<size_t>(1 << 20, 3 * frame));
    size_t filled = 0;
    while (!ended) {
      ssize_t got = recv(fd, &buffer[filled], buffer.size() - filled, 0);
      if (got <= 0) throw std::runtime_error("the relay closed the connection");
      filled += got;
      const int64_t t = now();
      size_t at = 0;
      for (; filled - at >= frame; at += frame) message(&buffer[at], t);
      std::memmove(&buffer[0], &buffer[at], filled - at);
      filled -= at;
    }
    close(fd);
  }
};

int main(int argc, char** argv) try {
  if (argc != 4 && argc != 5) throw std::runtime_error("relay_load BYTES SECONDS flat|window|paced|pacedN [MD5SUM]");
  Load load;
  load.frame = std::max<size_t>(FIXED, std::atoi(argv[1]));
  load.seconds = std::atof(argv[2]);
  load.mode = argv[3];
  if (load.mode.rfind("paced", 0) == 0) load.hertz = load.mode == "paced" ? 1000 : std::stod(load.mode.substr(5));
  if (argc == 5) load.md5sum = argv[4];
  int listening = socket(AF_INET, SOCK_STREAM, 0);
  sockaddr_in where{};
  socklen_t size = sizeof where;
  where.sin_family = AF_INET, where.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  if (bind(listening, reinterpret_cast<sockaddr*>(&where), size) || listen(listening, 4)) throw std::runtime_error("cannot listen");
  getsockname(listening, reinterpret_cast<sockaddr*>(&where), &size);
  std::cout << ntohs(where.sin_port) << std::endl;
  std::thread publisher([&] { load.publish(listening); });
  int port;
  std::string topic;
  std::string line;
  std::getline(std::cin, line);
  std::istringstream(line) >> port >> topic >> load.pid;
  load.subscribe(port, topic == "-" ? "/load" : topic);
  publisher.join();
  std::sort(load.delays.begin(), load.delays.end());
  const auto delay = [&](double part) { return load.delays.empty() ? 0.0 : load.delays[size_t(part * (load.delays.size() - 1))] / 1e3; };
  std::printf("{\"messages_per_s\": %.0f, \"sent\": %llu, \"lost\": %llu, \"disordered\": %llu, \"p50_us\": %.1f, \"p99_us\": %.1f, \"cpu_us\": %.1f}\n",
              load.last > load.first ? load.received / ((load.last - load.first) / 1e9) : 0.0, (unsigned long long)load.sent,
              (unsigned long long)(load.sent - load.received), (unsigned long long)load.disordered, delay(.5), delay(.99), load.cpu_after - load.cpu_before);
} catch (const std::exception& error) {
  std::cerr << "relay_load: " << error.what() << std::endl;
  std::_Exit(1);
}
