"""The options of the commands of a team."""
