#!/bin/sh
# Remove what install.sh made on this computer: the witness or follower, its lease, its keys and all its firewall rules.
set -eu

die() { echo "remove.sh: $*" >&2; exit 1; }

PATH=$PATH:/usr/sbin:/sbin
[ "$(id -u)" = 0 ] || die "run it as root: sudo $0"
for unit in rosrv-witness rosrv-witness-follow rosrv-witness-shut; do
    if [ -e "/etc/systemd/system/$unit.service" ]; then
        systemctl disable --quiet --now "$unit.service"
        rm -f "/etc/systemd/system/$unit.service"
    fi
done
systemctl daemon-reload

# Both programs: after an upgrade of the system, the rules may be those of the one that is no longer used. One may
# not work in this kernel; rules of a program that has failed since then end with the next boot.
works=
for backend in nft iptables; do
    [ -e /etc/rosrv/witness.py ] || break
    program=$backend
    [ "$backend" = nft ] || program=iptables-restore
    command -v "$program" >/dev/null || continue
    if said=$(/usr/bin/python3 -I /etc/rosrv/witness.py remove --backend "$backend" 2>&1); then
        works=yes
    else
        echo "remove.sh: warning: $backend fails, so only rules of the other program are removed: $said" >&2
    fi
done
[ -n "$works" ] || [ ! -e /etc/rosrv/witness.py ] || die "no program can remove the rules; repair one, and run this again"
if nft list table ip rosrv_witness >/dev/null 2>&1 || iptables-save 2>/dev/null | grep -q rosrv-witness; then
    die "firewall rules remain: nft list table ip rosrv_witness; iptables-save | grep rosrv-witness"
fi
rm -rf /var/lib/rosrv-witness
rm -f /etc/rosrv/witness.py /etc/rosrv/witness.json /etc/rosrv/remove-witness.sh
rmdir /etc/rosrv 2>/dev/null || true
echo "remove.sh: this computer no longer admits or shuts out appliances"
