#!/bin/sh
# Enrols this machine (Debian or Ubuntu) as @name@ with the ROSRV appliance at @url@: makes its key here, has it
# certified with a one-time token, and joins. Run again, it goes on where it ended.
#
#   sudo sh rosrv-@name@-join.sh [TOKEN]       without TOKEN it is asked for, or taken from ROSRV_ENROL_TOKEN
#
# The appliance is recognised by the key of its server and the fingerprint of its authority, which stand here.
set -eu

url="@url@"
pin="@pin@"
authority="@authority@"

die() { echo "join.sh: $*" >&2; exit 1; }
[ "$(id -u)" = 0 ] || die "run it as root: sudo sh $0"
umask 077
folder=${ROSRV_FOLDER:-/etc/rosrv/@name@}
mkdir -p "$folder"

for program in curl openssl tar; do
    command -v "$program" >/dev/null && continue
    command -v apt-get >/dev/null || die "$program is needed"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends curl openssl tar ca-certificates
done

fingerprint() { openssl x509 -in "$1" -noout -fingerprint -sha256 | cut -d= -f2 | tr -d ':' | tr 'A-F' 'a-f'; }
public() { openssl pkey -in "$1" -pubout; }

[ -s "$folder/rosrv.key" ] || openssl ecparam -name secp384r1 -genkey -noout -out "$folder/rosrv.key"
kit="$folder/rosrv-@name@"
if [ -s "$kit/swanctl/x509/rosrv.pem" ] && [ "$(fingerprint "$kit/swanctl/x509ca/rosrv-ca.pem")" = "$authority" ] \
    && [ "$(openssl x509 -in "$kit/swanctl/x509/rosrv.pem" -noout -pubkey)" = "$(public "$folder/rosrv.key")" ] \
    && [ -z "${1-}" ]; then
    echo "join.sh: @name@ is already enrolled; with a new token it enrols again"
else
    token=${1-${ROSRV_ENROL_TOKEN-}}
    if [ -z "$token" ]; then
        printf 'one-time token: ' >&2
        read -r token
    fi
    openssl req -new -key "$folder/rosrv.key" -subj "/CN=@name@" -out "$folder/rosrv.csr"
    # The token goes through a file: what stands in a command's arguments, others on this machine can read.
    printf '{"token":"%s","request":"%s"}' "$token" "$(awk '{printf "%s\\n", $0}' "$folder/rosrv.csr")" > "$folder/body"
    status=$(curl --silent --show-error --max-time 60 --insecure --pinnedpubkey "$pin" -o "$folder/answer" \
        -w '%{http_code}' -H 'Content-Type: application/json' -H 'Accept: application/gzip' \
        --data-binary @"$folder/body" "$url/v1/enrol") || {
        rm -f "$folder/body"
        die "no answer from the appliance at $url, or one with another key (curl says it above)"
    }
    rm -f "$folder/body"
    [ "$status" = 200 ] || die "the appliance refused ($status): $(cat "$folder/answer")"
    rm -rf "$kit"
    tar -xzf "$folder/answer" -C "$folder"
    rm -f "$folder/answer"
    if [ "$(fingerprint "$kit/swanctl/x509ca/rosrv-ca.pem")" != "$authority" ]; then
        rm -rf "$kit"
        die "the certificate of the authority is another than the one this script was made for"
    fi
fi
mkdir -p "$kit/swanctl/private"
install -m 0600 "$folder/rosrv.key" "$kit/swanctl/private/rosrv.key"
exec sh "$kit/join.sh"
