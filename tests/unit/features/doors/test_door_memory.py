import pytest

from appliance.features.doors.door_memory import ClientMemory, DoorMemory
from appliance.features.doors.quotas import DOOR_BYTES
from appliance.features.doors.viewer_queue import ViewerQueue, ViewerStalledError

_MIB = 1 << 20


def fill(memory: ClientMemory) -> ViewerQueue[str]:
    queue = ViewerQueue[str](memory=memory)
    queue.configure("/image", depth=1000, interval=0.0)
    with pytest.raises(ViewerStalledError):
        for _ in range(17):
            queue.reply(b"x" * _MIB)
    for _ in range(17):
        queue.put("/image", b"", _MIB, 0.0)
    return queue


def test_a_message_without_room_costs_the_client_no_other() -> None:
    queue = ViewerQueue[str](memory=DoorMemory().client())
    queue.configure("/image", depth=10, interval=0.0)
    queue.put("/image", b"kept", _MIB, 0.0)
    queue.put("/image", b"too large", 60 * _MIB, 0.0)
    assert queue.dropped == 1
    assert queue.take(0.0) == ("/image", b"kept")


def test_greedy_clients_leave_memory_for_the_next_one() -> None:
    door = DoorMemory()
    clients = [door.client() for _ in range(31)]
    greedy = [fill(memory) for memory in clients]
    held = sum(memory.held for memory in clients)
    assert DOOR_BYTES.bounds.whole * 0.9 < held <= DOOR_BYTES.bounds.whole
    assert min(memory.held for memory in clients) > 2 * _MIB
    quiet = ViewerQueue[str](memory=door.client())
    quiet.configure("/image", depth=1, interval=0.0)
    quiet.put("/image", b"", _MIB, 0.0)
    quiet.reply(b"pong")
    assert quiet.dropped == 0
    queue = greedy[0]
    while queue.take(0.0) is not None:
        pass
    for memory in clients:
        memory.close()
    queue.reply(b"an answer after the end")
    assert quiet.take(0.0) and quiet.take(0.0)
    assert door.shared == 0


def test_the_clients_of_one_host_leave_memory_for_other_hosts() -> None:
    door = DoorMemory()
    greedy = [door.client("10.0.0.9") for _ in range(24)]
    for memory in greedy:
        while memory.try_take(_MIB):
            pass
    assert door.most_shared * 0.7 < door.shared <= door.most_shared * 0.75
    assert "the clients of one host would hold" in greedy[-1].refusal(_MIB)
    other = door.client("10.0.0.10")
    other.take(16 * _MIB)
    for memory in (*greedy, other):
        memory.close()
    assert door.shared == 0 and not door.shared_by
