"""The data plane: TCPROS connections between publishers and subscribers, clients and services."""
