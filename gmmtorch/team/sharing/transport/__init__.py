"""Transports of datagrams: a simulated network, UDP and Zenoh, with encryption."""
