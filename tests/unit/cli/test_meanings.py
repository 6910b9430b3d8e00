"""Words of neighbouring tools that `rosrv` does not have as commands."""

import re
from collections import Counter

import pytest

from appliance.cli.main import all_verbs
from appliance.cli.meanings import IN_GROUPS, MEANINGS, READING, REMARKS, SYNONYMS, answer_to, is_reading
from appliance.cli.verb_table import Group, Verbs
from tests.support.command import rosrv, table

VERBS = all_verbs()
COMMANDS = {name for name, _verb in table()}
GROUPS: dict[str, Verbs] = {"": VERBS} | {
    name: verb.verbs for name, verb in VERBS.items() if isinstance(verb, Group)
}
# The meanings of words for people who know other tools; `-`: a word without a sensible answer.
GUESSES = """
    audit tail: logs log events tail journal follow, trace, watch, host logs, guard events
    audit search: search history find grep, query
    audit why: why debug
    status: ps health info stat uptime ping ready alive is-active top, state
    selftest: repair doctor test diagnose wtf
    host block: block ban deny drop reject kick, host ban, host deny, banip
    host unblock: unblock unban, host unban, host allow
    host blocks: banned jail
    host list: peers machines clients hosts, host ls
    policy grant: allow permit accept, policy allow, whitelist, chmod, grant
    policy show: rules ruleset acl, policy list, policy cat, chain
    policy reload: reload apply daemon-reload, policy apply, refresh
    policy explain: can-i auth, policy can-i, explain
    policy rollback: undo revert rollback, policy undo, checkout
    policy check: lint validate, policy lint
    policy enforce: enable
    policy diff: diff, policy compare
    policy confirm: commit, policy keep
    topic info: hz bw type, topic hz, topic bw
    topic list: topics rostopic list ls show get, topic ls
    node list: nodes rosnode, node info, node ls
    record now: bag rosbag snapshot, record start
    monitor replay: play replay
    config show: conf env configure
    certificate: cert ca
    token list: users keys sessions, token ls
    token add: adduser login, token create
    token revoke: token rm, token delete
    guard list: guards safety deadman
    guard remove: guard rm
    monitor disable: guard off, guard disable, guard shadow
    monitor enable: guard on, guard enable
    host add: join vpn enroll register ipsec
    standby status: switch
    standby switch: failover promote switchover failback
    drive status: lease control joystick
    alarm list: alerts warnings alarms
    alarm acknowledge: ack
    backup: save
    limits: quota df free rotate
    survey: scan services rosservice graph
    certificate: fingerprint
    systemctl start|docker compose start|rosrv up: start
    systemctl stop|docker compose stop|Ctrl-C: stop shutdown down kill
    systemctl restart|docker compose restart|Ctrl-C: restart reboot
    rosnode kill NODE: kill, node kill
    stops no robot: stop-robot robot-stop robot_stop estop halt freeze stop emergency-stop
    stops no robot: drive stop, guard stop, guard pause, guard halt
    tools of ROS: run launch pub exec call
    clears nothing: flush reset clear
    at boot|at each boot: enable disable
    -h: man
    rostopic pub: topic pub
    -: exit-maintenance attach-console, token update, record clear, host clear
"""
EFFECT = re.compile(r"`rosrv ([a-z][a-z -]*)")


def guesses() -> list[tuple[str, str]]:
    rows = [line.strip().split(": ") for line in GUESSES.strip().splitlines()]
    return [
        (meant, guess)
        for meant, words in rows
        for piece in words.split(", ")
        for guess in ([piece] if piece.split()[0] in GROUPS else piece.split())
    ]


def answer(guess: str) -> str:
    group, _space, word = guess.rpartition(" ")
    return answer_to(word, group, GROUPS[group])


def effects(said: str) -> set[str]:
    return {name for name in EFFECT.findall(said) if name in COMMANDS and not is_reading(name)}


def test_guesses_lead_to_what_is_meant_and_to_no_other_effect() -> None:
    rows = guesses()
    answered = {guess: answer(guess) for _meant, guess in rows}
    assert len(answered) >= 110
    missed = [
        (guess, meant)
        for meant, guess in rows
        if meant != "-" and not any(one in answered[guess] for one in meant.split("|"))
    ]
    assert missed == []
    for guess, said in answered.items():
        words = {meant.split()[-1] for meant, other in rows if other == guess} | {guess.split()[-1]}
        words |= {"enforce"} if "enable" in words else set()
        assert {name for name in effects(said) if name.split()[-1] not in words} == set(), said


def test_an_answer_is_a_line_on_standard_error_with_status_2() -> None:
    done = rosrv("reload", "--now")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "rosrv: no such command 'reload'. Did you mean `rosrv policy reload`, `rosrv monitor reload` or"
        " `rosrv host reload`?\n"
    )


@pytest.mark.parametrize("group", GROUPS)
def test_likeness_of_letters_proposes_no_command_with_an_effect(group: str) -> None:
    """A slip of a finger gets commands without an effect, or the list."""
    meant = {word for words in (*MEANINGS, *REMARKS, *SYNONYMS) for word in words.split()}
    for name in GROUPS[group]:
        for place in range(len(name)):
            slip = name[:place] + name[place + 1 :]
            if slip and slip not in meant and slip not in GROUPS[group]:
                said = answer_to(slip, group, GROUPS[group])
                assert effects(said) <= {f"{one} {slip}" for one in GROUPS}, said


def test_each_row_is_about_words_of_other_tools_and_names_commands_that_exist() -> None:
    for rows in (MEANINGS, REMARKS):
        words = Counter(word for row in rows for word in row.split())
        assert {word for word, times in words.items() if times > 1 or word in VERBS} == set()
    meant = [*MEANINGS.values(), *(commands for _group, _words, commands, _remark in IN_GROUPS)]
    named = {name.partition(" -")[0] for row in meant for name in row.split(", ") if name}
    assert named - {"-h"} <= COMMANDS
    assert {f"{group} {word}" for group, words, *_ in IN_GROUPS for word in words.split()} & COMMANDS == set()
    assert {f"{group} {verb}".strip() for group in READING for verb in READING[group].split()} <= COMMANDS
    inner = {name.split()[-1] for name in COMMANDS if " " in name}
    for row in SYNONYMS:
        assert set(row.split()) & inner and set(row.split()) - inner, row
