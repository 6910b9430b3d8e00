#!/bin/sh
# Takes away what join.sh made: the tunnel to the ROSRV appliance, its key, and the closed ROS ports.
set -eu

[ "$(id -u)" = 0 ] || { echo "leave.sh: run it as root: sudo ./leave.sh" >&2; exit 1; }

systemctl disable --quiet --now rosrv-tunnel.service 2>/dev/null || true
plugin=/etc/strongswan.d/charon/kernel-libipsec.conf
rm -f /etc/swanctl/conf.d/rosrv.conf /etc/swanctl/x509/rosrv.pem /etc/swanctl/x509ca/rosrv-ca.pem
rm -f /etc/swanctl/private/rosrv.key
swanctl --terminate --ike @connection@ >/dev/null 2>&1 || true
swanctl --load-all --noprompt >/dev/null 2>&1 || true
if [ -e "$plugin.rosrv-before" ]; then
    mv "$plugin.rosrv-before" "$plugin"
    systemctl try-restart strongswan.service
fi
systemctl disable --quiet --now rosrv-protect.service 2>/dev/null || true
rm -f /etc/systemd/system/rosrv-protect.service /etc/systemd/system/rosrv-tunnel.service
rm -f /etc/rosrv/protect.nft /etc/rosrv/keep.sh
systemctl daemon-reload
echo "leave.sh: this machine (@name@) has left. On the appliance: rosrv host revoke @name@"
