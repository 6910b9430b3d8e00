#!/bin/sh
# Install the witness of two ROSRV appliances on this computer, or the follower of a witness. Run it again to repair it.
set -eu

die() { echo "install.sh: $*" >&2; exit 1; }
say() { echo "install.sh: $*"; }

cd "$(dirname "$0")"
PATH=$PATH:/usr/sbin:/sbin
[ "$(id -u)" = 0 ] || die "run it as root: sudo ./install.sh"
/usr/bin/python3 -c 'import sys; sys.exit(sys.version_info < (3, 5))' 2>/dev/null \
    || die "/usr/bin/python3 must be Python 3.5 or newer: sudo apt install python3"
# nft may be installed on a kernel without nf_tables. Then the units name the other program, also after an update.
options=
if command -v nft >/dev/null && ! said=$(nft list tables 2>&1); then
    iptables-save >/dev/null 2>&1 || die "nft fails, and iptables does not work either: $said"
    say "nft fails here, so the rules are those of iptables: $said"
    options=" --backend iptables"
elif ! command -v nft >/dev/null && ! command -v iptables-restore >/dev/null; then
    die "neither nft nor iptables is installed: sudo apt install nftables"
fi
[ -d /run/systemd/system ] || die "this computer is not run by systemd; install the services of this folder by hand"

unit=rosrv-witness
other=rosrv-witness-follow
if [ ! -e rosrv-witness.service ]; then
    unit=rosrv-witness-follow
    other=rosrv-witness
fi
for file in witness.py witness.json remove.sh rosrv-witness-shut.service "$unit.service"; do
    [ -s "$file" ] || die "$file is missing: copy the whole folder of the kit"
done
# A small installation of Python lacks modules; the services would then never start.
said=$(/usr/bin/python3 -I witness.py --help 2>&1) \
    || die "/usr/bin/python3 cannot run witness.py ($(echo "$said" | tail -n 1)): sudo apt install python3"

# A file is complete before it gets its name: a boot after a power cut must find the boot rule.
put() {
    (umask 077; sed "${4:-}" "$2" > "$3.new")
    chmod "$1" "$3.new"
    sync
    mv "$3.new" "$3"
}
install -d -m 0755 /etc/rosrv
put 0755 witness.py /etc/rosrv/witness.py
put 0600 witness.json /etc/rosrv/witness.json
put 0755 remove.sh /etc/rosrv/remove-witness.sh
for name in rosrv-witness-shut "$unit"; do
    put 0644 "$name.service" "/etc/systemd/system/$name.service" "s/^ExecStart=.*/&$options/"
done
if [ -e "/etc/systemd/system/$other.service" ]; then
    systemctl disable --quiet --now "$other.service"
    rm -f "/etc/systemd/system/$other.service"
fi

# Only the first installation of this kit begins a lease: an earlier lease knows which appliance has all data.
if [ "$unit" = rosrv-witness ] && [ ! -e "@lease@" ]; then
    systemctl stop rosrv-witness.service 2>/dev/null || true
    /usr/bin/python3 -I /etc/rosrv/witness.py begin --in-sync @name@ --epoch @epoch@ || die "the lease was not written"
    say "the first lease is written: @name@ has all data"
fi

systemctl daemon-reload
systemctl enable --quiet rosrv-witness-shut.service "$unit.service"
# It has started when the program has written its rules and answers or follows; until then, systemd tries again.
systemctl restart "$unit.service" || true
sync
tries=0
until systemctl is-active --quiet "$unit.service"; do
    tries=$((tries + 1))
    [ "$tries" -lt 100 ] || die "$unit does not run: $(journalctl -q -o cat -n 1 "_SYSTEMD_UNIT=$unit.service" || true)
install.sh: repair that; systemd tries again until then. All lines: journalctl -u $unit -u rosrv-witness-shut"
    sleep 0.1
done
if command -v ip >/dev/null && ! ip route get @fixed@ >/dev/null 2>&1; then
    say "warning: this computer has no route to @fixed@: choose an unused address of its own network"
fi
say "$unit runs. Check it: journalctl -u $unit"
say "close the ROS ports to all other machines: rosrv protect --appliance @own@ --appliance @other@ --apply"
say "start the nodes with ROS_MASTER_URI=http://@fixed@:@master@"
