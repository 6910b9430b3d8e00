#!/bin/sh
# Takes away what join.sh made: the tunnel to the ROSRV appliance, its key and certificates, and the closed ROS ports.
# What was not there before, as packages, stays. Run again, it finds nothing to do.
set -eu

[ "$(id -u)" = 0 ] || { echo "leave.sh: run it as root: sudo ./leave.sh" >&2; exit 1; }
cd /

@stop@

if systemd; then
    systemctl disable --quiet --now rosrv-tunnel.service rosrv-renew.timer 2>/dev/null || true
else
    stop keep
    stop renew
fi
rm -f /etc/strongswan.d/rosrv.conf /etc/swanctl/conf.d/rosrv.conf /etc/swanctl/x509/rosrv.pem /etc/swanctl/x509ca/rosrv-ca.pem
rm -f /etc/swanctl/x509crl/rosrv.crl /etc/swanctl/x509crl/rosrv-crl.pem
rm -f /etc/swanctl/private/rosrv.key /etc/swanctl/private/rosrv.key.unconfirmed
rm -rf /etc/swanctl/rosrv.new
for connection in @connections@; do swanctl --terminate --ike "$connection" >/dev/null 2>&1 || true; done
swanctl --load-all --clear --noprompt >/dev/null 2>&1 || true
plugin=/etc/strongswan.d/charon/kernel-libipsec.conf
if [ -e "$plugin.rosrv-before" ]; then
    mv "$plugin.rosrv-before" "$plugin"
    if systemd; then systemctl try-restart strongswan.service; fi
fi
if systemd; then
    systemctl disable --quiet --now rosrv-protect.service 2>/dev/null || true
    rm -f /etc/systemd/system/rosrv-protect.service /etc/systemd/system/rosrv-tunnel.service
    rm -f /etc/systemd/system/rosrv-renew.service /etc/systemd/system/rosrv-renew.timer
    systemctl daemon-reload
else
    stop charon
    # Sockets that charon leaves behind.
    rm -f /run/charon.vici /run/charon.ctl /run/charon.dck /run/charon.lkp /run/charon.wlst /run/charon.enfy
    rm -rf /run/rosrv
fi
# Rules of `rosrv protect` that do not admit this appliance stay, and stored ones come back.
for table in rosrv_protect rosrv_tunnel; do
    if nft list table inet "$table" 2>/dev/null | grep -qFw @appliance@; then nft delete table inet "$table"; fi
done
if systemd; then systemctl try-restart rosrv-ports.service 2>/dev/null || true; fi
rm -rf /etc/rosrv/protect.nft /etc/rosrv/keep.sh /etc/rosrv/renew.sh /etc/rosrv/leave.sh "/etc/rosrv/@name@"
rmdir /etc/rosrv 2>/dev/null || true
echo "leave.sh: this machine (@name@) has left. On the appliance: rosrv host revoke @name@"
if ! nft list table inet rosrv_protect >/dev/null 2>&1; then
    echo "leave.sh: its ROS ports are open to all; to close them: rosrv protect"
fi
