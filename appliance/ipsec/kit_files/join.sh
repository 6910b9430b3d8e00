#!/bin/sh
# Joins this machine (Debian or Ubuntu) to the ROSRV appliance as @name@, through an IPsec tunnel.
set -eu

die() { echo "join.sh: $*" >&2; exit 1; }
say() { echo "join.sh: $*"; }

cd "$(dirname "$0")"
[ "$(id -u)" = 0 ] || die "run it as root: sudo ./join.sh"
[ -f swanctl/private/rosrv.key ] || die "the private key is not here: put it at swanctl/private/rosrv.key"
command -v apt-get >/dev/null || die "this script is for Debian and Ubuntu; README says what it does"

missing=""
for package in charon-systemd strongswan-swanctl libcharon-extra-plugins libstrongswan-standard-plugins nftables iproute2; do
    dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q "ok installed" || missing="$missing $package"
done
if [ -n "$missing" ]; then
    say "installing$missing"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing
fi

# ESP in the kernel where it has it, else in user space.
state="src 192.0.2.1 dst 192.0.2.2 proto esp spi 0x6f737276"
key=0x$(printf '%072d' 0)
plugin=/etc/strongswan.d/charon/kernel-libipsec.conf
if ip xfrm state add $state reqid 1 mode tunnel aead 'rfc4106(gcm(aes))' "$key" 128 2>/dev/null; then
    ip xfrm state delete $state
    say "ESP runs in the kernel"
    if [ -e "$plugin.rosrv-before" ]; then mv "$plugin.rosrv-before" "$plugin"; fi
else
    [ -e /dev/net/tun ] || die "the kernel has no ESP, and there is no /dev/net/tun for ESP in user space"
    say "ESP runs in user space"
    [ -e "$plugin.rosrv-before" ] || cp "$plugin" "$plugin.rosrv-before"
    printf 'kernel-libipsec {\n  load = yes\n}\n' > "$plugin"
fi

install -d -m 0755 /etc/swanctl/conf.d /etc/swanctl/x509 /etc/swanctl/x509ca /etc/rosrv
install -d -m 0700 /etc/swanctl/private
install -m 0644 swanctl/swanctl.conf /etc/swanctl/conf.d/rosrv.conf
install -m 0644 swanctl/x509/rosrv.pem /etc/swanctl/x509/rosrv.pem
install -m 0644 swanctl/x509ca/rosrv-ca.pem /etc/swanctl/x509ca/rosrv-ca.pem
install -m 0600 swanctl/private/rosrv.key /etc/swanctl/private/rosrv.key
install -m 0644 protect.nft /etc/rosrv/protect.nft
install -m 0755 keep.sh /etc/rosrv/keep.sh

cat > /etc/systemd/system/rosrv-protect.service <<'UNIT'
[Unit]
Description=Closes the ROS ports of this machine to all but the ROSRV appliance
Before=network-pre.target
Wants=network-pre.target

[Service]
Type=oneshot
RemainAfterExit=yes
ExecStart=/usr/sbin/nft -f /etc/rosrv/protect.nft
ExecStop=/usr/sbin/nft delete table inet rosrv_protect

[Install]
WantedBy=multi-user.target
UNIT
cat > /etc/systemd/system/rosrv-tunnel.service <<'UNIT'
[Unit]
Description=Asks for the tunnel to the ROSRV appliance whenever it is not there
After=strongswan.service

[Service]
ExecStart=/etc/rosrv/keep.sh
Restart=always

[Install]
WantedBy=multi-user.target
UNIT
systemctl daemon-reload
systemctl enable --quiet rosrv-protect.service
systemctl restart rosrv-protect.service
systemctl enable --quiet strongswan.service
systemctl restart strongswan.service
swanctl --load-all --noprompt >/dev/null || die "strongSwan did not take the tunnel: journalctl -u strongswan"

say "waiting for the tunnel to @endpoint@"
swanctl --initiate --child @child@ --ike @connection@ --timeout 20 >/dev/null 2>&1 || true
if ! swanctl --list-sas --ike @connection@ | grep -q INSTALLED; then
    die "no tunnel. journalctl -u strongswan says why here; on the appliance: rosrv audit search --event 'tunnel refused'"
fi
systemctl enable --quiet rosrv-tunnel.service
systemctl restart rosrv-tunnel.service
say "the tunnel is up: this machine is @address@ to the appliance. For every shell that runs ROS nodes:"
echo "  export ROS_MASTER_URI=@master@ ROS_IP=@address@"
