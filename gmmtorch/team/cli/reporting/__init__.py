"""What the commands of a team write and show."""
