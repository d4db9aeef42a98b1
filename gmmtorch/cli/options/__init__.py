"""The options of the commands: their schemas, help and conversion to objects of the library."""
