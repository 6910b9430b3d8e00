"""The hosts with an IPsec tunnel: their table, certificates, enrolment and tunnels."""
