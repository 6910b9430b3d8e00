#!/bin/sh
# Asks for the tunnel whenever it is not there: charon gives up where it is refused, which an appliance that is just
# starting may do. Arguments are passed to swanctl.

while :; do
    if ! swanctl --list-sas --ike @connections@ "$@" 2>/dev/null | grep -q INSTALLED; then
        swanctl --initiate --child @child@ --ike @connections@ --timeout 20 "$@" >/dev/null 2>&1
    fi
    sleep 5
done
