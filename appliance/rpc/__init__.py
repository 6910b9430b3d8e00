"""XML-RPC over HTTP, bounded: the server, fair turns of hosts, and the client."""
