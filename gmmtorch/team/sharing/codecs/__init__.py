"""Codecs of raw points, which the bytes of mixtures are compared with."""
