"""XML-RPC over HTTP with limits: the server, fair turns of hosts, and the client."""
