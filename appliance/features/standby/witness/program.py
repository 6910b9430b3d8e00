"""Hold the lease of two appliances on the robot's own computer, and enforce it in the robot's firewall.

    witness.py shut   [--settings FILE]                              at boot: shut out both appliances
    witness.py serve  [--settings FILE]                              answer the appliances
    witness.py follow [--settings FILE]                              on another computer: do as the witness does
    witness.py begin  [--settings FILE] --in-sync a,b --epoch N      write the lease again, after damage
    witness.py remove [--settings FILE]                              remove the firewall rules

It runs alone, as one file, with the standard library of Python 3.5 to 3.12 and the program `nft` or `iptables`.

1. A claim is granted only after the lease has expired, to an appliance in the in-sync set. A grant increments the
   epoch, saves it, and changes the firewall before it is answered. If one of these fails, nothing is granted.
2. Only the holder changes the in-sync set. Each change is on the disk before it is answered.
3. Every start waits one expiry before the first grant. After a reboot both appliances are shut out; a renewal of
   the holder admits it again, since no other appliance has had a grant.
4. A damaged or missing lease shuts out both appliances, until an operator runs `begin`.
5. A full disk prevents no change: the file of the lease keeps its size. Each answer says why the next takeover would
   fail: a disk that cannot be written, or a program that cannot list the rules or fails a trial of those of the next
   takeover. Neither stops a renewal of the holder.
6. After a change that may be on the disk or not, each appliance counts as in sync for the holder, and the lease is
   saved again before the next change.

The firewall translates one fixed address to the holder, and rejects all other traffic of the other appliance with TCP
resets; idle connections are reset. Tunnels, ping, resets and requests to the witness pass. The rules are for IPv4:
give the appliances no IPv6 address that the robot reaches.
"""

import argparse
import os
import platform
import select
import shutil
import sys
from typing import List

from appliance.features.standby.witness.errors import WitnessError
from appliance.features.standby.witness.firewall import LeaseFirewall, chosen_backend, remove_rules
from appliance.features.standby.witness.following import follow
from appliance.features.standby.witness.idle_connections import RESET_SECONDS, IdleConnections
from appliance.features.standby.witness.lease_file import LeaseFile, LeaseRecord
from appliance.features.standby.witness.protocol import HIGHEST
from appliance.features.standby.witness.serving import serve
from appliance.features.standby.witness.settings import WitnessSettings, read_settings

SETTINGS = "/etc/rosrv/witness.json"


def _shut(settings: WitnessSettings, backend: str) -> None:
    """Shut out both appliances. At a boot there is no connection to reset."""
    LeaseFirewall(settings, backend).admit("")
    idle = IdleConnections(settings)
    idle.reset("")
    while idle.go_on():
        select.select([], [], [], RESET_SECONDS)


def begin(settings: WitnessSettings, lease: LeaseFile, in_sync: List[str], epoch: int) -> None:
    wrong = [name for name in in_sync if name not in settings.appliances]
    if wrong or not in_sync:
        raise WitnessError("--in-sync: %r is not an appliance of the settings" % ",".join(wrong))
    if not 0 < epoch < HIGHEST:
        raise WitnessError("--epoch: use a number greater than the epoch that both appliances show")
    try:
        before = lease.read().epoch
    except WitnessError:
        before = 0  # damaged or missing: the reason for this command
    if epoch <= before:
        raise WitnessError("--epoch: the lease has epoch %d already; use a greater number" % before)
    lease.write(LeaseRecord(epoch, "", tuple(sorted(set(in_sync))), ""))


def _require_place(settings: WitnessSettings, command: str) -> None:
    if (command == "follow") != bool(settings.follows_as):
        place = "the computer with the witness" if settings.follows_as else "a follower"
        raise WitnessError("`%s` is a command for %s; this computer has other settings" % (command, place))


def main(arguments: List[str]) -> int:
    parser = argparse.ArgumentParser(description="The witness of two appliances, on the robot's computer.")
    parser.add_argument("command", choices=("shut", "serve", "follow", "begin", "remove"))
    parser.add_argument("--settings", default=SETTINGS, help="default: %(default)s")
    parser.add_argument("--backend", choices=("nft", "iptables"), help="default: nft, on Linux 4.18 or newer")
    parser.add_argument("--in-sync", default="", help="begin: the appliances that have all data, such as a,b")
    parser.add_argument("--epoch", type=int, default=0, help="begin: greater than both appliances show")
    chosen = parser.parse_args(arguments)
    try:
        if chosen.command == "begin":
            backend = ""  # it changes no rule
        else:
            backend = chosen.backend or chosen_backend(platform.release(), shutil.which)
        if chosen.command == "remove":
            remove_rules(backend)  # even if the settings are damaged
            return 0
        settings = read_settings(chosen.settings)
        lease = LeaseFile(settings.state, tuple(sorted(settings.appliances)))
        if chosen.command == "shut":
            _shut(settings, backend)
            return 0
        _require_place(settings, chosen.command)
        if not os.isatty(2):
            os.set_blocking(2, False)  # a reader of the log that has stopped must not hold the lease
        with lease:
            if chosen.command == "begin":
                begin(settings, lease, [name for name in chosen.in_sync.split(",") if name], chosen.epoch)
            else:
                (serve if chosen.command == "serve" else follow)(settings, backend, lease)
    except (WitnessError, OSError) as error:
        sys.stderr.write("witness.py: %s\n" % error)
        return 1
    return 0
