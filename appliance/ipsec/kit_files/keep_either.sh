#!/bin/sh
# Keeps a tunnel to the active one of two appliances. Only the active one answers, at the same address in the tunnel.
# When it does not answer there, both are asked for a tunnel at the same time; the tunnel that opens replaces the
# earlier one, which stays until then. So a lost packet ends no tunnel. Arguments are passed to swanctl.

reached() { ping -q -n -c 1 -W 1 -I @address@ @appliance@ >/dev/null 2>&1; }
quiet() { swanctl "$@" 2>/dev/null; }

# Prints each tunnel and each attempt: its number, its connection, its state (INSTALLED: it carries packets).
tunnels() {
    quiet --list-sas "$@" | awk '
        /^rosrv.*: #/ {
            if (id != "") print id, name, state
            name = $1; sub(/:$/, "", name); id = $2; gsub(/[#,]/, "", id); state = $3
        }
        /^  [^ ].* INSTALLED,/ { state = "INSTALLED" }
        END { if (id != "") print id, name, state }'
}

# Ends all tunnels and attempts but the tunnel with this number.
end() {
    keep=$1
    shift
    tunnels "$@" | while read -r id name state; do
        [ "$id" = "$keep" ] || quiet --terminate --ike-id "$id" --force "$@" >/dev/null
    done
}

# Asks for a tunnel of this connection, within these seconds. The other tunnels end if it opens, else this attempt.
attempt() {
    name=$1
    seconds=$2
    shift 2
    if quiet --initiate --child @child@ --ike "$name" --timeout "$seconds" "$@" >/dev/null; then
        open=$(tunnels "$@" | awk -v name="$name" '$2 == name && $3 == "INSTALLED" { print $1 }' | sort -n | tail -n 1)
        [ -n "$open" ] || return
        moved=$(tunnels "$@" | awk -v name="$name" '$2 != name && $3 == "INSTALLED" { print $1 }')
        end "$open" "$@"
        # The other appliance does not know the open connections. A node that only reads would wait for long.
        if [ -n "$moved" ]; then ss -K dst @appliance@ >/dev/null 2>&1; fi
    else
        tunnels "$@" | awk -v name="$name" '$2 == name && $3 != "INSTALLED" { print $1 }' | while read -r id; do
            quiet --terminate --ike-id "$id" --force "$@" >/dev/null
        done
    fi
}

rounds=0
while :; do
    reached &
    check=$!
    # Quick at first; a network that is slow gets more time, and one that is gone costs little.
    seconds=1
    [ "$rounds" -le 20 ] || seconds=20
    if [ "$rounds" -gt 0 ]; then
        sleep 1 &  # a refusal comes at once
        for name in @connections@; do attempt "$name" "$seconds" "$@" & done
    fi
    if wait "$check"; then
        wait
        rounds=0
        sleep 0.5
        continue
    fi
    wait
    rounds=$((rounds + 1))
    # An appliance that was restarted does not know its earlier tunnel, which prevents another one.
    [ $((rounds % 5)) -ne 0 ] || end "" "$@"
    [ "$rounds" -le 20 ] || sleep 5
done
