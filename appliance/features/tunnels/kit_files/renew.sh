#!/bin/sh
# Renews the certificate of @name@ through the tunnel when a third of its life is left, and gets the list of revoked
# certificates anew. Run every hour, by rosrv-renew.timer or (where there is no systemd) a loop in the background that
# join.sh starts. --now: whatever is left.
set -eu

rest="@rest@"
pin="@pin@"
swanctl=${SWANCTL_DIR:-/etc/swanctl}
key="$swanctl/private/rosrv.key"
certificate="$swanctl/x509/rosrv.pem"
new="$swanctl/rosrv.new"  # beside both, so that each is replaced by a name only
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
trap 'rm -rf "$work" "$new"' EXIT
umask 077
rm -rf "$new"
mkdir "$new"

# What openssl finds out about the signature of a list it says, and does not tell by its exit status.
if ask "$rest/v1/revocations" && [ "$status" = 200 ] && LC_ALL=C openssl crl -in "$work/answer" -noout \
    -CAfile "$swanctl/x509ca/rosrv-ca.pem" 2>&1 | grep -qx "verify OK"; then
    # In DER: swanctl takes 64 KiB of a list at most, and PEM is a third longer.
    openssl crl -in "$work/answer" -outform DER -out "$work/crl.der"
    mkdir -p "$swanctl/x509crl"
    install -m 0644 "$work/crl.der" "$new/crl"
    mv "$new/crl" "$swanctl/x509crl/rosrv.crl"
    rm -f "$swanctl/x509crl/rosrv-crl.pem"
fi

# Before the certificate is confirmed, which revokes the one before: both are in place, and charon has them.
confirm() {
    swanctl --load-creds --clear --noprompt ${VICI_URI:+--uri "$VICI_URI"} >/dev/null || die "strongSwan did not take the new certificate"
    swanctl --load-conns ${VICI_URI:+--uri "$VICI_URI"} >/dev/null || die "strongSwan did not take the new certificate"
    ask -X POST "$rest/v1/hosts/@name@/renewed" || die "no answer from $rest ($status)"
    case $status in
        204) rm -f "$key.unconfirmed"; echo "renew.sh: the new certificate is in force" ;;
        422) rm -f "$key.unconfirmed" ;;
        *) die "the appliance did not take the new certificate ($status): $(cat "$work/answer")" ;;
    esac
}
fits() { public=$(openssl x509 -in "$certificate" -noout -pubkey) && [ "$public" = "$(openssl pkey -in "$key" -pubout)" ]; }
# What was left in the middle: a new certificate that is in place and was not confirmed, or less, which does not count.
if [ -e "$key.unconfirmed" ]; then
    if fits && ! cmp -s "$key" "$key.unconfirmed"; then confirm; else mv "$key.unconfirmed" "$key"; fi
fi

seconds() { date -u -d "$(openssl x509 -in "$certificate" -noout "$1" | cut -d= -f2)" +%s; }
if [ "${1-}" != --now ] && fits; then
    begin=$(seconds -startdate)
    end=$(seconds -enddate)
    left=$((end - $(date -u +%s)))
    if [ $((left * 3)) -gt $((end - begin)) ]; then
        echo "renew.sh: nothing to do, the certificate is good for another $((left / 86400)) days"
        exit 0
    fi
fi

openssl ecparam -name secp384r1 -genkey -noout -out "$work/new.key"
openssl req -new -key "$work/new.key" -subj "/CN=@name@" -out "$work/new.csr"
# The two say the same, but OpenSSL 1.1.1 has the first only, and the first signs nothing with Ed25519.
if openssl pkey -in "$key" -noout -text | head -1 | grep -qi ed25519; then
    openssl pkeyutl -sign -rawin -inkey "$key" -in "$work/new.csr" -out "$work/proof"
else
    openssl dgst -sha384 -sign "$key" -out "$work/proof" "$work/new.csr"
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

install -m 0600 "$key" "$new/before"
install -m 0600 "$work/new.key" "$new/key"
install -m 0644 "$work/new.pem" "$new/certificate"
sync "$new/before" "$new/key" "$new/certificate"
mv "$new/before" "$key.unconfirmed"
mv "$new/key" "$key"
mv "$new/certificate" "$certificate"
confirm
