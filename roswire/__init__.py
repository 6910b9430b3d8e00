"""ROS 1 on the wire, without I/O: names, URIs, XML-RPC, TCPROS and message definitions."""
