"""The work of the commands of a team."""
