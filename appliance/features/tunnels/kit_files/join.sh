#!/bin/sh
# Joins this machine (Debian or Ubuntu) to the ROSRV appliance as @name@, through an IPsec tunnel. Run again, it puts
# right what is not. With systemd the services rosrv-protect, rosrv-tunnel and rosrv-renew.timer hold it; where there
# is no systemd (a container) the same programs run in the background until leave.sh.
set -eu

die() { echo "join.sh: $*" >&2; exit 1; }
say() { echo "join.sh: $*"; }

cd "$(dirname "$0")"
[ "$(id -u)" = 0 ] || die "run it as root: sudo ./join.sh"
[ -f swanctl/private/rosrv.key ] || die "the private key is not here: put it at swanctl/private/rosrv.key"

missing=""
for package in charon-systemd strongswan-swanctl libcharon-extra-plugins libstrongswan-standard-plugins nftables \
    iproute2 iputils-ping openssl curl; do
    dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q "ok installed" || missing="$missing $package"
done
if [ -n "$missing" ]; then
    command -v apt-get >/dev/null || die "this script is for Debian and Ubuntu; README says what it does"
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
    never='ifname != "ipsec'
    if [ -e "$plugin.rosrv-before" ]; then mv "$plugin.rosrv-before" "$plugin"; fi
else
    [ -e /dev/net/tun ] || die "the kernel has no ESP, and there is no /dev/net/tun for ESP in user space"
    say "ESP runs in user space"
    never="ipsec missing"
    [ -e "$plugin.rosrv-before" ] || cp "$plugin" "$plugin.rosrv-before"
    printf 'kernel-libipsec {\n  load = yes\n}\n' > "$plugin"
fi

begin() { date -u -d "$(openssl x509 -in "$1" -noout -startdate | cut -d= -f2)" +%s; }
# OpenSSL 3.2 and later print no spaces around the equals sign.
name_in() { openssl x509 -in "$1" -noout -subject | sed -n 's/.*CN *= *\([^ ,]*\)$/\1/p'; }
# A certificate that was renewed since this kit was made is not replaced by the kit's, which is revoked by now. One that
# is not valid yet was made while the appliance's clock was ahead.
renewed() {
    [ -s /etc/swanctl/x509/rosrv.pem ] && [ -s /etc/swanctl/private/rosrv.key ] \
        && cmp -s swanctl/x509ca/rosrv-ca.pem /etc/swanctl/x509ca/rosrv-ca.pem \
        && [ "$(name_in /etc/swanctl/x509/rosrv.pem)" = "@name@" ] \
        && [ "$(begin /etc/swanctl/x509/rosrv.pem)" -gt "$(begin swanctl/x509/rosrv.pem)" ] \
        && [ "$(begin /etc/swanctl/x509/rosrv.pem)" -le "$(date -u +%s)" ]
}

install -d -m 0755 /etc/swanctl/conf.d /etc/swanctl/x509 /etc/swanctl/x509ca /etc/swanctl/x509crl /etc/rosrv
install -d -m 0700 /etc/swanctl/private
if renewed; then
    say "the certificate in place was renewed since this kit was made: it stays"
else
    install -m 0644 swanctl/x509/rosrv.pem /etc/swanctl/x509/rosrv.pem
    install -m 0600 swanctl/private/rosrv.key /etc/swanctl/private/rosrv.key
    rm -f /etc/swanctl/private/rosrv.key.unconfirmed
fi
install -m 0644 swanctl/swanctl.conf /etc/swanctl/conf.d/rosrv.conf
install -m 0644 swanctl/x509ca/rosrv-ca.pem /etc/swanctl/x509ca/rosrv-ca.pem
# Without the rules for the other place of ESP: they would drop what comes through the tunnel, too.
sed "/$never/d" protect.nft > /etc/rosrv/protect.nft.new
nft -c -f /etc/rosrv/protect.nft.new \
    || die "nftables here does not take the rules (above); they need nftables 0.9.1 and Linux 4.20, or newer"
chmod 0644 /etc/rosrv/protect.nft.new
mv /etc/rosrv/protect.nft.new /etc/rosrv/protect.nft
install -m 0755 keep.sh renew.sh leave.sh /etc/rosrv/
# The kit was made elsewhere, for the usual range of ports.
closed=$(sed -n 's/^ *tcp dport \([0-9-]*\) .* reject with tcp reset$/\1/p' protect.nft)
range=$(cat /proc/sys/net/ipv4/ip_local_port_range)
first=${range%%[!0-9]*} last=${range##*[!0-9]}
if [ "$first" -lt "${closed%-*}" ] || [ "$last" -gt "${closed#*-}" ]; then
    say "warning: ROS nodes of this machine listen on $first-$last, and the kit closes only $closed:" \
        "on the appliance, rosrv host kit @name@ --ports $first-$last"
fi

write_units() {
    cat > /etc/systemd/system/rosrv-protect.service <<'UNIT'
[Unit]
Description=Closes the ROS ports of this machine to all but the ROSRV appliance
DefaultDependencies=no
Conflicts=shutdown.target
After=local-fs.target nftables.service netfilter-persistent.service ufw.service
# Stored rules of `rosrv protect` replace these. If they do not admit the appliance, keep.sh loads these again.
Before=rosrv-ports.service network-pre.target shutdown.target
Wants=network-pre.target

[Service]
Type=oneshot
RemainAfterExit=yes
ExecStart=/usr/sbin/nft -f /etc/rosrv/protect.nft

[Install]
WantedBy=multi-user.target
UNIT
    cat > /etc/systemd/system/rosrv-tunnel.service <<'UNIT'
[Unit]
Description=Keeps the tunnel to the ROSRV appliance and the rules of rosrv-protect.service
After=strongswan.service

[Service]
ExecStart=/etc/rosrv/keep.sh
Restart=always

[Install]
WantedBy=multi-user.target
UNIT
    cat > /etc/systemd/system/rosrv-renew.service <<'UNIT'
[Unit]
Description=Renews the certificate for the tunnel to the ROSRV appliance
After=rosrv-tunnel.service

[Service]
Type=oneshot
ExecStart=/etc/rosrv/renew.sh
UNIT
    cat > /etc/systemd/system/rosrv-renew.timer <<'UNIT'
[Unit]
Description=Looks every hour whether the certificate for the ROSRV appliance is to be renewed

[Timer]
OnBootSec=10min
OnUnitActiveSec=1h
RandomizedDelaySec=5min

[Install]
WantedBy=timers.target
UNIT
}

run=/run/rosrv
@stop@
# Where there is no systemd: a program in the background, by its pid file.
background() {
    what=$1
    shift
    stop "$what"
    mkdir -p "$run"
    setsid "$@" </dev/null >>"$run/$what.log" 2>&1 &
    echo $! > "$run/$what.pid"
}
# The keeper is stopped, as it would ask for tunnels, too. That of an earlier run comes back however this one ends.
keep() {
    trap - EXIT
    if systemd; then systemctl restart rosrv-tunnel.service; else background keep /etc/rosrv/keep.sh; fi
}
keep_at_exit() {
    trap keep EXIT
    trap 'exit 1' HUP INT TERM
}
restart_charon() {
    stop charon
    rm -f /run/charon.vici
    # charon writes to syslog, which a container does not have.
    cat > /etc/strongswan.d/rosrv.conf <<'CONF'
charon-systemd {
  filelog {
    stderr {
      default = 0
      lib = 1
      dmn = 1
      time_format = %FT%T
      flush_line = yes
    }
  }
}
CONF
    background charon charon-systemd
    tries=0
    while [ ! -S /run/charon.vici ]; do
        tries=$((tries + 1))
        [ "$tries" -lt 600 ] || die "charon does not start: $run/charon.log"
        sleep 0.1
    done
}

if systemd; then
    why="journalctl -u strongswan"
    write_units
    systemctl daemon-reload
    systemctl enable --quiet rosrv-protect.service
    systemctl restart rosrv-protect.service
    systemctl try-restart rosrv-ports.service 2>/dev/null || true
    systemctl enable --quiet strongswan.service
    if systemctl is-enabled --quiet rosrv-tunnel.service 2>/dev/null; then keep_at_exit; fi
    systemctl stop --quiet rosrv-tunnel.service
    systemctl restart strongswan.service
else
    why="/run/rosrv/charon.log"
    nft -f /etc/rosrv/protect.nft
    if [ -e "$run/keep.pid" ]; then keep_at_exit; fi
    stop keep
    restart_charon
fi

# ML-KEM beside Curve25519, where strongSwan has it here; the appliance takes it where it has it too.
if swanctl --list-algs 2>/dev/null | grep -q ML_KEM_768; then
    sed -i 's/\(proposals = \)\([a-z0-9-]*-x25519\),/\1\2-ke1_mlkem768, \2,/' /etc/swanctl/conf.d/rosrv.conf
fi
swanctl --load-all --noprompt >/dev/null || die "strongSwan did not take the tunnel: $why"

say "waiting for the tunnel to @endpoint@"
up() {
    for one in @connections@; do
        if swanctl --list-sas --ike "$one" | grep -q INSTALLED; then return; fi
    done
    return 1
}
said=""
for connection in @connections@; do
    up || said="$said$(swanctl --initiate --child @child@ --ike "$connection" --timeout 20 2>&1)" || true
done
if ! up; then
    printf '%s\n' "$said" >&2
    die "no tunnel: the lines above say why; on the appliance: rosrv audit search --event 'tunnel refused'"
fi
if ! ping -q -n -c 5 -i 0.3 -W 2 -I @address@ @appliance@ >/dev/null 2>&1; then
    die "the appliance answers no ping through the tunnel; keep.sh needs it: allow ICMP echo in this machine's firewall"
fi
if systemd; then systemctl enable --quiet rosrv-tunnel.service; fi
keep
if [ -z "@rest@" ]; then
    say "warning: the appliance's REST is not reached through tunnels: the certificate cannot be renewed by itself"
elif systemd; then
    systemctl enable --quiet rosrv-renew.timer
    systemctl restart rosrv-renew.timer
fi
if ! systemd; then
    background renew sh -c 'while sleep 3600; do
        [ -z "@rest@" ] || /etc/rosrv/renew.sh
        for log in /run/rosrv/*.log; do [ "$(wc -c < "$log")" -lt 1000000 ] || : > "$log"; done
    done'
fi
if [ -n "@rest@" ] && ! curl --silent --fail --max-time 20 --insecure --pinnedpubkey "@pin@" -o /dev/null "@rest@/v1/authority"; then
    say "warning: the appliance does not answer at @rest@ in the tunnel: the certificate cannot be renewed by itself"
fi
say "the tunnel is up: this machine is @address@ to the appliance. For every shell that runs ROS nodes:"
echo "  export ROS_MASTER_URI=@master@ ROS_IP=@address@"
