"""Raw packets of lidars, in messages and in network captures."""
