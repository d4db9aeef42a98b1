"""Objects of a team from the options of a command."""
