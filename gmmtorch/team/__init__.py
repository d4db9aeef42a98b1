"""Teams of robots: the replicated map, exploration, and their commands."""
