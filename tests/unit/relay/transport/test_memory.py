from appliance.quotas.pool import Bounds, QuotaClass
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.transport.memory import MemoryPool, RelayMemory, StallDetector


def shares(whole: int) -> MemoryPool:
    return MemoryPool("bytes", Bounds(whole, whole, 0, 0, share=1), lambda _host: QuotaClass.REGISTERED)


def take_all(pool: MemoryPool, host: str, step: int = 1) -> int:
    share = pool.of(host)
    while not share.refusal(step):
        share.add(step)
    return share.used


def test_a_host_may_have_as_much_as_is_left() -> None:
    pool = shares(96)
    assert [take_all(pool, host) for host in "abc"] == [48, 24, 12]
    assert pool.of("a").refusal() == (
        "a would use 49 bytes, leaving 11 for all others; a host may use at most as many as it leaves"
    )
    pool.of("a").add(-48)
    assert take_all(pool, "d") == 30
    assert take_all(pool, "b") == 27


def test_however_many_hosts_take_all_they_can_the_next_finds_room() -> None:
    pool = shares(1 << 20)
    hosts = [f"10.0.0.{number}" for number in range(200)]
    for _ in range(3000):
        for share in map(pool.of, hosts):
            if share.exhausted:
                share.add(-share.used // 8)
            else:
                share.add(256)
    robot = pool.of("robot")
    assert not robot.refusal((1 << 20) // 820)
    assert pool.total <= 1 << 20


def test_the_memory_of_a_relay_is_parted_as_the_table_says() -> None:
    memory = RelayMemory.of(RelayLimits(memory_bytes=1 << 28), lambda _host: QuotaClass.REGISTERED)
    wholes = [one.bounds.whole >> 20 for one in (memory.frames, memory.queues, memory.latched)]
    assert wholes == [128, 64, 64]
    assert take_all(memory.latched, "a", 1 << 20) == 32 << 20
    assert memory.bytes_held() == {"frames": 0, "queues": 0, "latched": 32 << 20, "headers": 0}


def test_a_host_that_is_gone_leaves_nothing() -> None:
    pool = shares(100)
    pool.of("a").add(5)
    pool.of("a").add(-5)
    assert list(pool.holders()) == []


def test_a_stall_is_what_does_not_change() -> None:
    stall = StallDetector(10)
    assert not any(stall.has_stalled(held, now) for held, now in ((5, 0), (5, 10), (6, 11), (6, 21)))
    assert stall.has_stalled(6, 21.5)
    assert not any(stall.has_stalled(held, now) for held, now in ((0, 22), (6, 40), (6, 50)))
