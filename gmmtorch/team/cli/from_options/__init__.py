"""Networks, missions and robots from the options of a command."""
