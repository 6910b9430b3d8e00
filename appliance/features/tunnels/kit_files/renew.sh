#!/bin/sh
# Renews the certificate of @name@ through the tunnel when a third of its life is left, and gets the list of revoked
# certificates anew. Run every hour, by rosrv-renew.timer or (where there is no systemd) a loop in the background that
# join.sh starts. --now: whatever is left.
set -eu

rest="@rest@"
pin="@pin@"
swanctl=${SWANCTL_DIR:-/etc/swanctl}
[ -n "$rest" ] || { echo "renew.sh: the appliance's REST cannot be reached through the tunnel: rosrv host kit @name@" >&2; exit 2; }

die() { echo "renew.sh: $*" >&2; exit 1; }
field() { sed -n 's/.*"'"$1"'":"\([^"]*\)".*/\1/p' "$2"; }
call() { curl --silent --show-error --max-time 30 --insecure --pinnedpubkey "$pin" "$@"; }
# What may be asked twice is, for a tunnel may just be coming up: in a loop, since curl 7.68 (Ubuntu 20.04) has no such
# option. The answer is in $work/answer, its status in $status (000: none).
ask() {
    tries=0
    until status=$(call -o "$work/answer" -w '%{http_code}' "$@" 2>"$work/errors") \
        && case $status in 429 | 5??) false ;; esac; do
        tries=$((tries + 1))
        [ "$tries" -le 10 ] || { cat "$work/errors" >&2; return 1; }
        sleep 1
    done
}

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
umask 077

# What openssl finds out about the signature of a list it says, and does not tell by its exit status.
if ask "$rest/v1/revocations" && [ "$status" = 200 ] && LC_ALL=C openssl crl -in "$work/answer" -noout \
    -CAfile "$swanctl/x509ca/rosrv-ca.pem" 2>&1 | grep -qx "verify OK"; then
    # In DER: swanctl takes 64 KiB of a list at most, and PEM is a third longer.
    openssl crl -in "$work/answer" -outform DER -out "$work/crl.der"
    install -D -m 0644 "$work/crl.der" "$swanctl/x509crl/rosrv.crl"
    rm -f "$swanctl/x509crl/rosrv-crl.pem"
fi

# What was left in the middle: a certificate that is in place and was not confirmed.
confirm() {
    ask -X POST "$rest/v1/hosts/@name@/renewed" || die "no answer from $rest ($status)"
    case $status in
        204) rm -f "$swanctl/private/rosrv.key.unconfirmed"; echo "renew.sh: the new certificate is in force" ;;
        422) rm -f "$swanctl/private/rosrv.key.unconfirmed" ;;
        *) die "the appliance did not take the new certificate ($status): $(cat "$work/answer")" ;;
    esac
}
if [ -e "$swanctl/private/rosrv.key.unconfirmed" ]; then confirm; fi

seconds() { date -u -d "$(openssl x509 -in "$swanctl/x509/rosrv.pem" -noout "$1" | cut -d= -f2)" +%s; }
begin=$(seconds -startdate)
end=$(seconds -enddate)
left=$((end - $(date -u +%s)))
if [ "${1-}" != --now ] && [ $((left * 3)) -gt $((end - begin)) ]; then
    echo "renew.sh: nothing to do, the certificate is good for another $((left / 86400)) days"
    exit 0
fi

openssl ecparam -name secp384r1 -genkey -noout -out "$work/new.key"
openssl req -new -key "$work/new.key" -subj "/CN=@name@" -out "$work/new.csr"
# The two say the same, but OpenSSL 1.1.1 has the first only, and the first signs nothing with Ed25519.
if openssl pkey -in "$swanctl/private/rosrv.key" -noout -text | head -1 | grep -qi ed25519; then
    openssl pkeyutl -sign -rawin -inkey "$swanctl/private/rosrv.key" -in "$work/new.csr" -out "$work/proof"
else
    openssl dgst -sha384 -sign "$swanctl/private/rosrv.key" -out "$work/proof" "$work/new.csr"
fi
printf '{"request":"%s","proof":"%s"}' "$(awk '{printf "%s\\n", $0}' "$work/new.csr")" \
    "$(openssl base64 -A -in "$work/proof")" > "$work/body"
status=$(call -o "$work/answer" -w '%{http_code}' -H 'Content-Type: application/json' --data-binary @"$work/body" \
    "$rest/v1/hosts/@name@/renew") || die "no answer from $rest (is the tunnel up? swanctl --list-sas)"
[ "$status" = 200 ] || die "the appliance refused ($status): $(cat "$work/answer")"
printf '%b' "$(field certificate "$work/answer")" > "$work/new.pem"
openssl verify -CAfile "$swanctl/x509ca/rosrv-ca.pem" "$work/new.pem" >/dev/null || die "what the appliance answered is not a certificate of its authority"
[ "$(openssl x509 -in "$work/new.pem" -noout -pubkey)" = "$(openssl pkey -in "$work/new.key" -pubout)" ] \
    || die "what the appliance answered is a certificate for another key"

install -m 0600 "$swanctl/private/rosrv.key" "$swanctl/private/rosrv.key.unconfirmed"
install -m 0600 "$work/new.key" "$swanctl/private/rosrv.key"
install -m 0644 "$work/new.pem" "$swanctl/x509/rosrv.pem"
swanctl --load-creds --clear --noprompt ${VICI_URI:+--uri "$VICI_URI"} >/dev/null || die "strongSwan did not take the new certificate"
swanctl --load-conns ${VICI_URI:+--uri "$VICI_URI"} >/dev/null || die "strongSwan did not take the new certificate"
confirm
