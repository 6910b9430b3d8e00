"""Decisions per second against the number of rules: `python benchmarks/policy_decisions.py`.

Seven of ten rules have exact names, and three have patterns. Each ten rules have a group, which has an address, a
network and another group. *Warm* requests were decided before, as most are on a robot. *Cold* ones have new names, so
no decision is cached. The ratio is to 10 rules, and should stay near 1. Times are medians of the rounds.
"""

import argparse
import ipaddress
import random
import statistics
import time

from appliance.policy.model import Category, Request
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy

SIZES = (10, 100, 1_000, 10_000)
REQUESTS = 4_000
ROUNDS = 7


def policy_text(rules: int) -> str:
    groups = max(1, rules // 10)
    lines = ["[Groups]"]
    for number in range(groups):
        nested = f" g{number + 1}" if number % 10 != 9 and number + 1 < groups else ""
        low, high = number & 255, number >> 8
        lines.append(f"g{number} = 10.{high}.{low}.1 172.{16 + number % 16}.{low}.0/24{nested}")
    lines += ["[Publishers]", "default = g0"]
    for number in range(rules):
        kind = number % 10
        key = f"/ns{number}/arm/joint" if kind < 7 else f"/ns{number}/*" if kind == 7 else f"/ns{number}/**"
        lines.append(
            f"{key} = g{number % groups} g{(number * 7) % groups} 192.168.{number >> 8 & 255}.{number & 255}"
        )
    return "\n".join(lines) + "\n"


def requests(rules: int, generation: int) -> list[Request]:
    chance = random.Random(generation)
    hosts = [ipaddress.ip_address(f"10.0.{n}.1") for n in range(50)]
    tails = ("arm/joint", "arm", "arm/wrist/state", f"new{generation}")
    found = []
    for number in range(REQUESTS):
        new = f"{generation}x{number}" if generation else ""
        name = f"/ns{chance.randrange(rules)}/{chance.choice(tails)}{new}"
        found.append(Request(chance.choice(hosts), "/n", Category.PUBLISH, name))
    return found


def microseconds(policy: Policy, batch: list[Request]) -> float:
    start = time.perf_counter()
    for request in batch:
        policy.decide(request)
    return (time.perf_counter() - start) / len(batch) * 1e6


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter).parse_args()
    print("  rules  groups  load ms  warm us  ratio  cold us  ratio      warm/s")
    base: tuple[float, float] | None = None
    for rules in SIZES:
        start = time.perf_counter()
        policy = compile_policy(policy_text(rules), file="benchmark.ini")
        load = (time.perf_counter() - start) * 1e3
        known = requests(rules, 0)
        microseconds(policy, known)
        warm = statistics.median(microseconds(policy, known) for _ in range(ROUNDS))
        cold = statistics.median(microseconds(policy, requests(rules, n)) for n in range(1, ROUNDS + 1))
        base = base or (warm, cold)
        print(
            f"{rules:>7} {max(1, rules // 10):>7} {load:>8.1f} {warm:>8.2f} {warm / base[0]:>6.2f}"
            f" {cold:>8.2f} {cold / base[1]:>6.2f} {1e6 / warm:>11,.0f}"
        )


if __name__ == "__main__":
    main()
