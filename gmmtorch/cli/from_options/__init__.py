"""Objects of the library made from the options of a command."""
