"""How datagrams travel: a simulated network, UDP and Zenoh, with encryption."""
