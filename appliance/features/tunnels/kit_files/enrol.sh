#!/bin/sh
# Enrols this machine (Debian or Ubuntu) as @name@ with the ROSRV appliance at @url@: makes its key here, has it
# certified with a one-time token, and joins. Run again, it goes on where it ended; a script with another token enrols
# the machine again, with another key.
#
#   sudo sh rosrv-@name@-join.sh [TOKEN]       without TOKEN it is asked for, or taken from ROSRV_ENROL_TOKEN
#
# The appliance is recognised by the key of its server and the fingerprint of its authority, which stand here.
set -eu

url="@url@"
pin="@pin@"
authority="@authority@"
token_id="@id@"  # its public part

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
kit="$folder/rosrv-@name@"
new="$folder/new"
# The kit of this script's token is complete in this folder, with its key.
made() { [ "$(cat "$1/token" 2>/dev/null)" = "$token_id" ]; }
take() { rm -rf "$kit"; mv "$new/rosrv-@name@" "$kit"; rm -rf "$new"; }

if made "$new/rosrv-@name@"; then take; fi
case ${1-} in "" | *_"${token_id}"_*) again=yes ;; *) again= ;; esac
if [ "$again" ] && made "$kit" && [ "$(fingerprint "$kit/swanctl/x509ca/rosrv-ca.pem")" = "$authority" ]; then
    echo "join.sh: @name@ is already enrolled; with a new token it enrols again"
else
    token=${1-${ROSRV_ENROL_TOKEN-}}
    if [ -z "$token" ]; then
        printf 'one-time token: ' >&2
        read -r token
    fi
    # All that is new is made beside what is there, and takes its place when it is complete. If the answer is lost, the
    # token is good for the same request only.
    if ! made "$new"; then
        rm -rf "$new"
        mkdir "$new"
        openssl ecparam -name secp384r1 -genkey -noout -out "$new/rosrv.key"
        openssl req -new -key "$new/rosrv.key" -subj "/CN=@name@" -out "$new/rosrv.csr"
        echo "$token_id" > "$new/token"
    fi
    # The token goes through a file: what stands in a command's arguments, others on this machine can read.
    printf '{"token":"%s","request":"%s"}' "$token" "$(awk '{printf "%s\\n", $0}' "$new/rosrv.csr")" > "$new/body"
    status=$(curl --silent --show-error --max-time 60 --insecure --pinnedpubkey "$pin" -o "$new/answer" \
        -w '%{http_code}' -H 'Content-Type: application/json' -H 'Accept: application/gzip' \
        --data-binary @"$new/body" "$url/v1/enrol") || {
        rm -f "$new/body"
        die "no answer from the appliance at $url, or one with another key (curl says it above)"
    }
    rm -f "$new/body"
    [ "$status" = 200 ] || die "the appliance refused ($status): $(cat "$new/answer")"
    tar -xzf "$new/answer" -C "$new"
    if [ "$(fingerprint "$new/rosrv-@name@/swanctl/x509ca/rosrv-ca.pem")" != "$authority" ]; then
        rm -rf "$new"
        die "the certificate of the authority is another than the one this script was made for"
    fi
    mkdir -p "$new/rosrv-@name@/swanctl/private"
    cp "$new/rosrv.key" "$new/rosrv-@name@/swanctl/private/rosrv.key"
    echo "$token_id" > "$new/rosrv-@name@/token"
    take
    rm -f "$folder/rosrv.key" "$folder/rosrv.csr"  # of an earlier script
fi
exec sh "$kit/join.sh"
