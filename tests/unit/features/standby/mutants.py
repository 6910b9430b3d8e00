"""Mutants of the rules of the lease, which the simulation must find.

    python -m tests.unit.features.standby.mutants HISTORIES      prints the first seed that finds each

Histories seldom show a replayed request, a late order, or a smaller epoch of the witness, so `test_lease.py` and
`witness/test_lease_rules.py` have a test of each.
"""

import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

from appliance.features.standby import lease
from appliance.features.standby.witness.one_file import witness_program
from tests.unit.features.standby.simulation import History, Product, Violation, module_of


class Mutant(NamedTuple):
    """A change of the source. `seed` is the first whose history finds it, with these kinds of faults (or any)."""

    part: str
    old: str
    new: str
    seed: int
    faults: tuple[str, ...] = ()


LEASE, WITNESS = "lease", "witness"
_STALE = ("bad link", "link of the appliances", "pause of the active")
MUTANTS = {
    "R1: a claim does not wait for the expiry": Mutant(WITNESS, "if self._clock() < self._expires:", "if False:", 2),
    "R1: an appliance out of sync gets the lease": Mutant(WITNESS, "if name not in before.in_sync:", "if False:", 29),
    "R1: a grant keeps the epoch": Mutant(WITNESS, "epoch=before.epoch + 1, holder=name", "holder=name", 0),
    "R1: a grant is not saved": Mutant(WITNESS, "            self._save(record)\n", "            pass\n", 0),
    "R1: a grant leaves the firewall": Mutant(WITNESS, "            self._enforce(name)\n", "            pass\n", 0),
    "R1: a failing firewall is ignored": Mutant(
        WITNESS, "            self._change(before)\n            raise\n", "            self._change(before)\n", 1
    ),
    "R1: the fixed address is not translated": Mutant(WITNESS, "            translate.append(", "            str(", 0),
    "R2: the holder answers alone at once": Mutant(LEASE, "self._other not in answer.in_sync", "True", 32),
    "R2: the holder answers alone until the standby is added": Mutant(
        LEASE, "                self.answers_alone = False\n", "", 29
    ),
    "R2: an older answer counts as removal": Mutant(
        LEASE, "if request.sequence > self._last_add:", "if True:", 624, _STALE
    ),
    "an uncertain change of the firewall counts as not made": Mutant(
        WITNESS, "except UncertainError:\n            self.admitted", "except OSError:\n            self.admitted", 1,
        ("firewall", "pause of the active"),
    ),
    "R3: valid longer than an expiry": Mutant(LEASE, "0.8 * EXPIRY", "1.3 * EXPIRY", 15),
    "R3: a promise counts from its arrival": Mutant(
        LEASE, "asked + CONFIDENCE", "now + CONFIDENCE", 1, ("bad link", "witness link", "pause")
    ),
    "R3: a promise is forgotten at a restart": Mutant(
        LEASE, "self._promised_until = now + EXPIRY\n        self._promised_to:",
        "self._promised_until = now\n        self._promised_to:", 280, ("witness link", "crash"),
    ),
    "R3: an older epoch gets promises, and its data is stored": Mutant(
        LEASE, "if epoch < self.epoch or epoch == self.held:", "if epoch == self.held:", 261,
        ("bad link", "crash of the active"),
    ),
    "R3: promises go on after the expiry, and hide that the witness answers": Mutant(
        LEASE, "if not self.follow(message.epoch) or self._expired:",
        "self._witnessed_at = self._started\n                if not self.follow(message.epoch):", 0,
    ),
    "R4: the first grant comes at once": Mutant(
        WITNESS, "self._expires = clock() + EXPIRY", "self._expires = clock()", 215
    ),
    "a holder of an older epoch stays active": Mutant(
        LEASE, "            self.epoch = epoch\n            self.held = None", "            self.epoch = epoch", 19
    ),
    "a switchover: an older renewal makes active": Mutant(
        LEASE, " and request.sequence > self._void_sequence", "", 1, ("switchover",)
    ),
}  # fmt: skip


def product_of(mutant: Mutant) -> Product:
    text = sources()[mutant.part]
    if text.count(mutant.old) != 1:
        raise ValueError(f"{mutant.old!r} is {text.count(mutant.old)} times in the {mutant.part}")
    return Product(
        **{mutant.part: module_of(text.replace(mutant.old, mutant.new), f"mutant_of_{mutant.part}")}
    )


@cache
def sources() -> dict[str, str]:
    return {WITNESS: witness_program(), LEASE: Path(lease.__file__).read_text(encoding="utf-8")}


def first_seed(product: Product, faults: tuple[str, ...], histories: int) -> int | None:
    for seed in range(histories):
        try:
            History(seed, product, faults=faults).run()
        except Violation:
            return seed
    return None


def main(arguments: list[str]) -> int:
    missing = 0
    for name, mutant in MUTANTS.items():
        seed = first_seed(product_of(mutant), mutant.faults, int(arguments[0]))
        missing += seed is None
        sys.stdout.write(f"{seed if seed is not None else 'NOT FOUND'}\t{name}\n")
        sys.stdout.flush()
    return min(missing, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
