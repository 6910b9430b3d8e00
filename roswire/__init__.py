"""ROS 1 on the wire: names, URIs, XML-RPC, TCPROS and message definitions. Only `node` does I/O."""
