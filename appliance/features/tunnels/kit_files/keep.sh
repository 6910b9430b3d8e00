#!/bin/sh
# Keeps a tunnel to the appliance. Of two appliances only the active one answers, at the same address in the tunnel.
# When no answer comes, each is asked for a tunnel at the same time; the tunnel that opens replaces the earlier one,
# which stays until then. So a lost packet ends no tunnel. Arguments are passed to swanctl.
# It also loads the rules of join.sh again that another firewall removed.

answers() { ping -q -n -c 1 -W "$1" -I @address@ @appliance@ >/dev/null 2>&1; }
quiet() { swanctl "$@" 2>/dev/null; }

# Prints each tunnel and each attempt: its number, its connection, its state (INSTALLED: it carries packets).
tunnels() {
    quiet --list-sas "$@" | awk '
        /^rosrv.*: #/ {
            if (id != "") print id, name, state
            name = $1; sub(/:$/, "", name); id = $2; gsub(/[#,]/, "", id); state = $3
        }
        /^  [^ ].* (INSTALLED|UPDATING|REKEYING|REKEYED),/ { state = "INSTALLED" }
        END { if (id != "") print id, name, state }'
}

# Prints the number of the newest tunnel of this connection.
tunnel() {
    name=$1
    shift
    tunnels "$@" | awk -v name="$name" '$2 == name && $3 == "INSTALLED" { print $1 }' | sort -n | tail -n 1
}

# Ends all tunnels and attempts but the tunnel with this number.
end() {
    keep=$1
    shift
    tunnels "$@" | while read -r id name state; do
        [ "$id" = "$keep" ] || quiet --terminate --ike-id "$id" --force "$@" >/dev/null
    done
}

# Prints the established TCP connections to the appliance as filters of ss, 50 in a line.
connections() {
    ss -Htn state synchronized dst @appliance@ 2>/dev/null | awk '
        { printf "%s( src %s and dst %s )", NR == 1 ? "" : NR % 50 == 1 ? "\n" : " or ", $(NF - 1), $NF }
        END { if (NR > 0) print "" }'
}

# Asks for a tunnel of this connection, within these seconds. The other tunnels end if it opens, else this attempt.
attempt() {
    name=$1
    seconds=$2
    shift 2
    # charon 5.9.5 and older would add a second CHILD_SA to an open tunnel, newer ones do nothing.
    [ -z "$(tunnel "$name" "$@")" ] || return 1
    quiet --initiate --child @child@ --ike "$name" --timeout "$seconds" "$@" >/dev/null
    open=$(tunnel "$name" "$@")  # also if it opened just after that time
    if [ -z "$open" ]; then
        tunnels "$@" | awk -v name="$name" '$2 == name && $3 != "INSTALLED" { print $1 }' | while read -r id; do
            quiet --terminate --ike-id "$id" --force "$@" >/dev/null
        done
        return 1
    fi
    # Another appliance does not know the earlier connections. A node that only reads would wait for long.
    if [ "$name" != "$last" ]; then
        echo "$before" | while read -r filter; do
            [ -z "$filter" ] || ss -K -t "$filter" >/dev/null 2>&1
        done
    fi
    end "$open" "$@"
}

admits() { nft list table inet "$1" 2>/dev/null | grep -qFw @appliance@; }
# Loads each table again that does not name the appliance. Rules of `rosrv protect` that do are as good: stored ones
# come first.
protect() {
    for table in rosrv_protect rosrv_tunnel; do
        admits "$table" && continue
        [ "$table" = rosrv_tunnel ] || systemctl try-restart rosrv-ports.service 2>/dev/null
        admits "$table" || sed -n "/^table inet $table\$/,/^}/p" /etc/rosrv/protect.nft | nft -f - || continue
        echo "keep.sh: the rules of the table $table were removed or replaced; they are in force again"
    done
}
while [ -e /etc/rosrv/protect.nft ]; do
    protect
    sleep 10
done &

# The connection of the last tunnel, until that ends.
last=$(tunnels "$@" | awk '$3 == "INSTALLED" { print $2; exit }')
rounds=0      # without an answer
unanswered=0  # the same, since a tunnel opened or was ended here
while :; do
    # Quick at first; a network that is slow gets more time, and one that is gone costs little.
    seconds=1
    [ "$unanswered" -lt 4 ] || seconds=4
    answers "$seconds" &
    check=$!
    pause=$check
    [ "$rounds" -le 20 ] || seconds=20
    attempts=""
    if [ "$unanswered" -gt 0 ]; then
        before=$(connections)
        sleep "$seconds" &  # a refusal comes at once
        pause=$!
        for name in @connections@; do
            attempt "$name" "$seconds" "$@" &
            attempts="$attempts $name:$!"
        done
    fi
    opened=""
    for attempt in $attempts; do
        if wait "${attempt#*:}"; then opened=${attempt%:*}; fi
    done
    if [ -n "$opened" ]; then
        last=$opened
        unanswered=0
        continue
    fi
    if wait "$check"; then
        rounds=0
        unanswered=0
        sleep 0.5
        continue
    fi
    wait "$pause"
    rounds=$((rounds + 1))
    unanswered=$((unanswered + 1))
    # An appliance that was restarted does not know its earlier tunnel, which prevents another one.
    if [ "$unanswered" -ge 5 ]; then
        end "" "$@"
        unanswered=0
    fi
    # An appliance that ended the tunnel may have been restarted: it does not know the earlier connections.
    tunnels "$@" | grep -q INSTALLED || last=""
    [ "$rounds" -le 20 ] || sleep 5
done
