"""Monitors that were learnt from drives of the simulated LandShark judge other drives and injected faults."""

from benchmarks.learning import KINDS, judge


def test_other_drives_are_quiet_and_four_fifths_of_the_faults_are_flagged() -> None:
    judged = judge(count=20, faults=2 * len(KINDS), seed=1)
    assert judged.false_alarms == []
    assert sum(judged.flagged.values()) >= 16, judged.missed
