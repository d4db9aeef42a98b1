"""The messages that robots send, byte by byte."""
