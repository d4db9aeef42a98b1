"""The binary format of components, in map files and in messages."""
